"""Neighbours: processes near each other or apart, when they are placed and when either moves."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    NeighbourRule,
    ProcessSpec,
    StandbyPolicy,
)
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, node, process

RACKS = {"a": "1", "b": "1", "c": "2", "d": "2"}


def near(*processes: str, by: str = "", prefer: bool = False) -> tuple[NeighbourRule, ...]:
    return (NeighbourRule("near", processes, by=by, prefer=prefer),)


def apart(*processes: str, by: str = "", prefer: bool = False) -> tuple[NeighbourRule, ...]:
    return (NeighbourRule("apart", processes, by=by, prefer=prefer),)


def spread(group: str, by: str = "", *, prefer: bool = False) -> tuple[NeighbourRule, ...]:
    return (NeighbourRule("apart", group=group, by=by, prefer=prefer),)


def machine(name: str, memory: float = 0.1, **fields: object) -> Machine:
    """Return a host with 1000 MiB, 80 % of which may be used, and the label of its rack."""
    labels = {"rack": RACKS[name]} if name in RACKS else {}
    return Machine(
        name, memory=1000 * MIB, busy={"memory": memory, "cpu": 0.05}, labels=labels, **fields
    )


def cluster_of(names: str, *specs: ProcessSpec, **settings: object) -> Cluster:
    settings = {"settle": 1.0, "hysteresis": 1.0, "cooldown": 2.0, **settings}
    return Cluster(*map(machine, names), **settings).with_processes(*specs)


def reasons(cluster: Cluster, name: str) -> Mapping[str, str]:
    return {one["name"]: one["reason"] for one in cluster.explain(name)["decision"]["hosts"]}


# --- near -------------------------------------------------------------------------------------


def test_a_process_runs_on_the_host_of_the_one_near_which_it_must_run() -> None:
    """The load of the host makes no difference."""
    cluster = cluster_of("ab", process("camera"))
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.read()
    cluster.submit(process("viewer", neighbours=near("camera")))
    assert cluster.where("camera") == cluster.where("viewer") == ["a"]
    assert reasons(cluster, "viewer")["b"] == ("camera, near which the process must run, runs on a")


def test_a_process_waits_for_a_neighbour_that_does_not_exist_and_blocks_no_other() -> None:
    """The reason names the neighbour; the process starts as soon as the neighbour has a host."""
    cluster = cluster_of("ab", process("viewer", neighbours=near("camera")), process("other"))
    why = "camera, near which the process must run, does not exist"
    assert cluster.phase("viewer") == "queued"
    assert cluster.recorded("waits") == [f"viewer waits: {why}"]
    assert cluster.explain("viewer")["reason"] == why
    assert cluster.where("other") == ["a"]
    cluster.submit(process("camera"))
    assert cluster.where("viewer") == cluster.where("camera") != []


def test_a_process_waits_behind_others_for_a_neighbour_and_says_so() -> None:
    """The reason is the neighbour, not the place in the queue."""
    cluster = cluster_of("a", process("one", memory=700), process("two", memory=700))
    cluster.submit(process("viewer", neighbours=near("camera")))
    assert "does not exist" in cluster.explain("viewer")["reason"]
    cluster.submit(process("camera"))
    assert cluster.explain("viewer")["reason"] == (
        "camera, near which the process must run, is queued"
    )


def test_a_neighbour_that_has_ended_is_named_as_such() -> None:
    """A cancelled process gives no host."""
    cluster = cluster_of("a", process("camera"))
    cluster.cancel("camera")
    cluster.submit(process("viewer", neighbours=near("camera")))
    assert "camera, near which the process must run, was cancelled" in cluster["viewer"].reason


def test_processes_that_name_each_other_start_together() -> None:
    """The first of them in the queue waits for no other."""
    first, second = near("p2"), near("p0")
    cluster = cluster_of(
        "ab", process("p0", neighbours=first), process("p1", neighbours=second),
        process("p2", neighbours=near("p1")),
    )  # fmt: skip
    assert cluster.where("p0") == cluster.where("p1") == cluster.where("p2") == ["a"]


def test_the_first_process_gets_a_host_with_room_for_those_tied_to_it() -> None:
    """The host with the largest margin has no room for both."""
    cluster = Cluster(machine("a", memory=0.1), Machine("big", busy={"memory": 0.3, "cpu": 0.1}))
    cluster.submit(
        process("camera", memory=100), process("viewer", memory=900, neighbours=near("camera"))
    )
    assert cluster.where("camera") == cluster.where("viewer") == ["big"]
    assert reasons(cluster, "camera")["a"] == "it cannot take viewer, which must run beside it"


def test_near_by_a_label_means_the_same_value() -> None:
    """Hosts without the label are in no place."""
    cluster = cluster_of("acdx")
    cluster.machines["a"].busy["memory"] = cluster.machines["d"].busy["memory"] = 0.5
    cluster.read()
    cluster.submit(process("camera", required_labels={"rack": "2"}))
    cluster.machines["c"].busy["memory"] = 0.75
    cluster.read()
    cluster.submit(process("viewer", neighbours=near("camera", by="rack")))
    assert (cluster.where("camera"), cluster.where("viewer")) == (["c"], ["d"])
    assert reasons(cluster, "viewer")["x"].endswith("runs on c with rack=2")


def test_a_preferred_neighbour_adds_to_the_score_and_is_named() -> None:
    """A preference loses to a host without room, and never waits."""
    cluster = cluster_of("ab", process("camera"))
    cluster.machines["a"].busy["memory"] = 0.5
    cluster.read()
    cluster.submit(process("viewer", neighbours=near("camera", prefer=True)))
    assert cluster.where("viewer") == ["a"]
    assert reasons(cluster, "viewer")["b"] == "0.100 by Eq. 1; +1: not near camera"
    cluster.submit(process("large", memory=600, neighbours=near("camera", "none", prefer=True)))
    assert cluster.where("large") == ["b"]


# --- apart ------------------------------------------------------------------------------------


@pytest.mark.parametrize("declares", ["first", "second", "both"])
def test_apart_is_symmetric(declares: str) -> None:
    """Either of the two may have the rule."""
    rules = {"first": apart("q"), "second": apart("p"), "both": apart("p")}
    p = process("p", neighbours=rules["first"] if declares != "second" else ())
    q = process("q", neighbours=rules["second"] if declares != "first" else ())
    cluster = cluster_of("a", p, q)
    assert (cluster.where("p"), cluster.where("q")) == (["a"], [])
    assert cluster["q"].reason == (
        "no host may take it: a runs p, apart from which the process must run; "
        "there is no other host"
    )
    cluster.submit(process("other"))
    assert cluster.where("other") == ["a"]  # a process that is set aside blocks no other
    cluster.add(machine("b"))
    cluster.wait(0.5)
    assert cluster.where("q") == ["b"]


def test_a_process_that_is_set_aside_starts_when_its_neighbour_ends() -> None:
    """The end of the neighbour frees the host."""
    cluster = cluster_of("a", process("p"), process("q", neighbours=apart("p")))
    cluster.cancel("p")
    cluster.wait(0.5)
    assert cluster.where("q") == ["a"]


def test_a_group_is_spread_over_the_values_of_a_label() -> None:
    """Each process of the group has a rack of its own; hosts without the label get none."""
    specs = [process(f"p{at}", neighbours=spread("maps", "rack")) for at in range(3)]
    cluster = cluster_of("abcx", *specs)
    assert [cluster.where(spec.name) for spec in specs] == [["a"], ["c"], []]
    assert cluster["p2"].reason == (
        "no host may take it: each of a and b has rack=1, as the host of p0, apart from which the "
        "process must run; c has rack=2, as the host of p1, apart from which the process must "
        "run; x has no label 'rack', by which the process must run apart from others"
    )


def test_a_preferred_spread_is_even() -> None:
    """Each neighbour on a host adds to its score."""
    rules = spread("maps", "rack", prefer=True)
    specs = [process(f"p{at}", neighbours=rules) for at in range(6)]
    cluster = cluster_of("abc", *specs)
    cluster.submit(process("last", neighbours=rules))
    assert cluster.counts()["c"] in (3, 4)
    assert "not apart from p" in reasons(cluster, "last")["b"]


# --- contradictions ---------------------------------------------------------------------------


def test_a_process_does_not_start_again_by_a_rule_that_can_no_longer_be_kept() -> None:
    """Its neighbour has changed since it ended, or since its version was replaced."""
    cluster = Cluster("a").with_processes(process("q"), process("p", neighbours=near("q")))
    cluster.apply("app", process("r", neighbours=near("q")))
    cluster.wait(3.0)
    cluster.apply("app", process("r", command=("new",)), process("x"), healthy_for=30.0)
    cluster.cancel("p", "q")
    cluster.wait(3.0)
    rules = (*apart("p"), *apart("r"))
    assert cluster.submit(process("q", neighbours=rules)).accepted
    says = "must run apart, and near each other: no hosts can keep both rules"
    assert says in cluster.restart("p").message
    cluster.finish("x", code=1)
    cluster.wait(3.0)
    (said,) = cluster.recorded("application_failed")
    assert f"does not return: q and r {says}" in said or f"does not return: r and q {says}" in said


CONTRADICTIONS = {
    "itself": ([process("p", neighbours=near("p"))], "p: it must run near itself"),
    "apart from itself": (
        [process("p", neighbours=apart("p"))], "p: it must run apart from itself",
    ),
    "one declares both": (
        [process("p", neighbours=near("q") + apart("q")), process("q")],
        "p and q must run apart, and near each other: no hosts can keep both rules",
    ),
    "each declares one": (
        [process("p", neighbours=near("q")), process("q", neighbours=apart("p", by="rack"))],
        "q and p must run apart by rack, and near each other: no hosts can keep both rules",
    ),
    "by one label": (
        [process("p", neighbours=near("q", by="rack") + apart("q", by="rack"))],
        "p and q must run apart by rack, and near each other by rack",
    ),
    "through a third": (
        [
            process("p", neighbours=near("r")), process("r", neighbours=near("q")),
            process("q", neighbours=apart("p")),
        ],
        "q and p must run apart, and near each other through other processes",
    ),
    "a group": (
        [
            process("p", neighbours=near("q") + spread("maps", "rack")),
            process("q", neighbours=spread("maps", "rack")),
        ],
        "q and p must run apart by rack, and near each other",
    ),
    "labels": (
        [
            process("p", neighbours=near("q"), required_labels={"arm": "left"}),
            process("q", required_labels={"arm": "right"}),
        ],
        "p and q must run near each other, but p requires arm=left, and q arm=right",
    ),
    "labels, by that label": (
        [
            process("p", neighbours=near("q", by="rack"), required_labels={"rack": "1"}),
            process("q", required_labels={"rack": "2"}),
        ],
        "p and q must run near each other by rack, but p requires rack=1, and q rack=2",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CONTRADICTIONS)
@pytest.mark.parametrize("at_once", [True, False])
def test_contradictions_are_refused_with_both_sides(case: str, *, at_once: bool) -> None:
    """The second side may be a process that runs already."""
    specs, text = CONTRADICTIONS[case]
    cluster = Cluster("a")
    replies = [cluster.submit(*specs)] if at_once else [cluster.submit(one) for one in specs]
    (refused,) = [reply for reply in replies if not reply.accepted]
    assert text in refused.message
    assert refused.message.endswith("Nothing was queued")


@pytest.mark.parametrize(
    "rules",
    [
        near("q", by="rack") + apart("q"),
        near("q", by="rack") + apart("q", by="room"),
        near("q") + apart("q", prefer=True),
        near("q", "r"),
    ],
)
def test_rules_that_some_hosts_keep_are_accepted(rules: tuple[NeighbourRule, ...]) -> None:
    """In one rack, but on two hosts."""
    assert Cluster("a").submit(process("p", neighbours=rules), process("q")).accepted


# --- moves ------------------------------------------------------------------------------------


def together() -> Cluster:
    specs = movable("camera"), movable("viewer", neighbours=near("camera"))
    cluster = cluster_of("a", *specs)
    cluster.add(machine("b"))
    cluster.wait(1.0)
    return cluster


@pytest.mark.parametrize("asked", ["camera", "viewer"])
def test_processes_tied_to_one_host_move_together(asked: str) -> None:
    """Whichever of them is moved."""
    cluster = together()
    assert cluster.migrate(asked, "b").accepted
    cluster.wait(2.0)
    assert cluster.where("camera") == cluster.where("viewer") == ["b"]
    assert cluster.recorded("separated") == []
    other = "viewer" if asked == "camera" else "camera"
    assert (
        f"{other} moves from a to b by relaunch: it must run near {asked}, which moves there"
        in (cluster.recorded("migration_begun"))
    )


def test_a_drain_moves_them_together() -> None:
    """The drained host has neither of them in the end."""
    cluster = together()
    cluster.set_host("a", "drain")
    cluster.wait(3.0)
    assert cluster.where("camera") == cluster.where("viewer") == ["b"]
    assert cluster.recorded("separated") == []


def test_an_eviction_moves_them_together() -> None:
    """The host over its limit loses both."""
    cluster = together()
    cluster.machines["a"].shown["viewer"] = {"memory": 300 * MIB}
    cluster.machines["a"].busy["memory"] = 0.6
    cluster.wait(4.0)
    assert cluster.where("camera") == cluster.where("viewer") == ["b"]


def test_a_process_stays_with_a_neighbour_that_cannot_move() -> None:
    """The refusal names the neighbour and its reason."""
    cluster = cluster_of("a", movable("camera"), process("viewer", neighbours=near("camera")))
    cluster.add(machine("b"))
    cluster.wait(1.0)
    assert cluster.migrate("camera", "b").message == (
        "camera must stay near viewer, and viewer has no migration strategy; give it `migration:` "
        "in its file"
    )


def test_the_destination_has_room_for_all_that_move_together() -> None:
    """Each alone would fit."""
    specs = (
        movable("camera", memory=300),
        movable("viewer", memory=300, neighbours=near("camera")),
    )
    cluster = cluster_of("a", *specs)
    cluster.add(machine("b", memory=0.3))
    cluster.wait(1.0)
    assert "memory: needs" in cluster.migrate("camera", "b").message
    assert "has room for camera" in cluster.migrate("camera").message
    cluster.add(machine("c"))
    cluster.wait(1.5)
    assert cluster.migrate("camera").host == "c"


def test_a_process_moves_to_no_host_of_one_from_which_it_must_be_apart() -> None:
    """The rule of the other one counts as well."""
    cluster = cluster_of("ab", movable("p"), movable("q", neighbours=apart("p")))
    cluster.wait(1.0)
    for moved, there in (("p", "b"), ("q", "a")):
        other = "q" if moved == "p" else "p"
        assert f"it runs {other}, apart from which" in cluster.migrate(moved, there).message
    assert cluster.migrate("p").message == (
        "no host can take p: b runs q, apart from which the process must run"
    )


def test_by_a_label_each_may_move_within_the_place() -> None:
    """A move out of the rack is refused for both of them."""
    cluster = cluster_of(
        "a", movable("camera"), movable("viewer", neighbours=near("camera", by="rack"))
    )
    for name in "bc":
        cluster.add(machine(name))
    cluster.wait(1.0)
    for name in ("camera", "viewer"):
        assert "near which the process must run" in cluster.migrate(name, "c").message
        assert cluster.migrate(name).host == "b"
        cluster.wait(3.0)
    assert cluster.where("camera") == cluster.where("viewer") == ["b"]


def test_after_the_loss_of_a_host_the_process_returns_to_its_neighbour() -> None:
    """The separation is recorded once, and ends when the process can move."""
    lost = HostLossPolicy("elsewhere", 0.0)
    cluster = cluster_of(
        "a", movable("camera", host_loss=lost), movable("viewer", neighbours=near("camera")),
        suspect=1.0, lease=3.0,
    )  # fmt: skip
    cluster.add(machine("b"))
    cluster.wait(1.0)
    cluster.cut("a", seconds=8.0)
    assert cluster.where("camera") == ["a", "b"]
    why = "it runs on a, and not near camera, which runs on b"
    assert cluster.recorded("separated") == [f"viewer: {why}"]
    assert why in cluster.explain("viewer")["reason"]
    cluster.reconnect("a")
    cluster.rejoin("a", seconds=12.0)
    assert cluster.where("camera") == cluster.where("viewer") == ["b"]
    assert cluster.recorded("separated") == [f"viewer: {why}"]


def test_a_process_that_starts_again_prefers_the_host_of_those_near_it() -> None:
    """A cancelled and resubmitted camera returns to its viewer."""
    cluster = cluster_of("ab", process("camera"), process("viewer", neighbours=near("camera")))
    cluster.machines["a"].busy["memory"] = 0.5
    cluster.read()
    cluster.cancel("camera")
    cluster.submit(process("camera"))
    assert cluster.where("camera") == ["a"]


def test_a_standby_is_apart_from_others_and_in_another_place_of_its_spread() -> None:
    """A standby need not be near the neighbours of its process."""
    guarded = node(
        "p", migration=MigrationPolicy("handoff"), standby=StandbyPolicy(wanted=True),
        neighbours=near("camera") + apart("planner") + spread("p", "rack"),
    )  # fmt: skip
    camera = process("camera", required_labels={"rack": "1"})
    cluster = cluster_of("ab", camera, guarded)
    cluster.discover("p", cluster.where("p")[0])
    cluster.wait(3.0)
    assert len(cluster.where("p")) == 1
    cluster.add(machine("c"))
    cluster.submit(process("planner", required_labels={"rack": "2"}))
    cluster.wait(5.0)
    assert len(cluster.where("p")) == 1
    cluster.add(machine("d"))
    cluster.wait(5.0)
    assert cluster.where("p")[1:] == ["d"]


def test_rules_survive_a_restart_of_the_master() -> None:
    """The journal has them."""
    cluster = cluster_of("a", process("p", neighbours=apart("q")))
    cluster.restart_master()
    cluster.submit(process("q"))
    assert cluster.phase("q") == "set_aside"
    cluster.cancel("p")
    cluster.wait(0.5)
    assert cluster.where("q") == ["a"]
    assert cluster.state.neighbours.declared == cluster.state.neighbours.about == {}


def test_processes_without_neighbours_have_no_rules_to_read() -> None:
    """Their demands stay equal, and share one ranking."""
    cluster = cluster_of("ab", process("p"), process("q", neighbours=apart("p")))
    cluster.submit(process("r"), process("s"))
    assert cluster["r"].demand is not None
    assert cluster["r"].demand[1].neighbours == ()
    assert cluster["q"].demand[1].neighbours != ()


# --- labels that are not known yet --------------------------------------------------------------


def two_in_a_rack(cluster: Cluster) -> tuple[str, str]:
    """Let `db2` wait for rack 2, apart from `db1`; return the host of `db1`, and the other one."""
    (on,) = cluster.where("db1")
    cluster.machines["c"].busy["memory"] = 0.75
    cluster.read()
    cluster.submit(process("db2", 300, neighbours=apart("db1", by="rack")))
    assert cluster.phase("db2") == "queued"
    return on, {"a": "b", "b": "a"}[on]


def test_a_restart_of_the_master_keeps_the_labels_of_a_host_that_reports_late() -> None:
    """The journal has the labels, also while the host is lost."""
    cluster = cluster_of("abc", process("db1", 300), lease=5.0)
    on, other = two_in_a_rack(cluster)
    cluster.machines[on].connected = False
    cluster.restart_master()
    cluster.wait(20.0)
    assert (cluster.phase("db2"), cluster.where("db2")) == ("queued", [])
    why = "it has rack=1, as the host of db1, apart from which the process must run"
    assert reasons(cluster, "db2")[other] == why


def test_a_changed_label_is_known_after_a_restart_of_the_master() -> None:
    """The slave has reported another label since it registered first."""
    cluster = cluster_of("abc", process("db1", 300))
    on, _ = two_in_a_rack(cluster)
    cluster.machines[on].labels = {"rack": "7"}
    cluster.register(cluster.machines[on])
    cluster.kill_master()
    assert cluster.state.hosts.by_name[on].description.labels == {"rack": "7"}


def test_a_process_waits_until_an_unknown_label_is_reported() -> None:
    """A journal of an earlier version has no labels. The reason names the host."""
    cluster = cluster_of("abc", process("db1", 300))
    on, other = two_in_a_rack(cluster)
    for desired in cluster.intents["host"].values():
        del desired["labels"]
    cluster.machines[on].connected = False
    cluster.restart_master()
    cluster.wait(5.0)
    assert cluster.where("db2") == []
    why = (
        f"the label 'rack' of {on}, the host of db1, apart from which the process must run, is not "
        f"known until it reports"
    )
    assert reasons(cluster, "db2")[other] == why


def test_a_process_is_not_separated_from_one_on_a_host_with_unknown_labels() -> None:
    """The master does not move the process, either."""
    cluster = cluster_of("abc", process("camera"))
    (on,) = cluster.where("camera")
    cluster.set_host(on, "cordon")
    cluster.submit(movable("viewer", neighbours=near("camera", by="rack")))
    assert cluster.where("viewer") not in ([on], [])
    for desired in cluster.intents["host"].values():
        del desired["labels"]
    cluster.machines[on].connected = False
    cluster.restart_master()
    cluster.wait(30.0)
    assert not cluster.recorded("separated")


def test_a_standby_waits_if_the_host_of_its_primary_has_no_place() -> None:
    """A missing label is no other value."""
    cluster = Cluster(*map(machine, "ab"), Machine("x")).with_processes()
    for name in "ab":
        cluster.set_host(name, "cordon")
    cluster.submit(
        node(
            "p", migration=MigrationPolicy("handoff"),
            standby=StandbyPolicy(wanted=True, apart_by=("rack",)),
        )
    )  # fmt: skip
    cluster.discover("p", on="x")
    for name in "ab":
        cluster.set_host(name, "uncordon")
    cluster.wait(5.0)
    assert cluster.where("p") == ["x"]
