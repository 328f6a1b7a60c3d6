"""Reload: settings of the master, and descriptions of hosts, change without a restart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rosrm.core.master import events as happened
from rosrm.core.master.commands import ReadSettings, Reply
from rosrm.extensions.placement import PolicySettings, ScoringLink
from rosrm.model.orders import ReloadSettings
from rosrm.model.values import Container, ResourceDescription
from tests.unit.core.cluster import GIB, Cluster, Eq1, Machine, process


def ask(cluster: Cluster) -> int:
    """Request a reload, and return the number of the request."""
    return cluster.request(happened.ReloadRequested(0))


def read(cluster: Cluster, request: int = 0, fault: str = "", **changes: Any) -> None:
    """Let the master read a file with some changed settings of the core."""
    settings = None if fault else replace(cluster.state.settings, **changes)
    changed = tuple(f"the setting {name}" for name in changes)
    cluster.tell(happened.SettingsRead(request, fault, settings, changed=changed))


def answers(cluster: Cluster, *outcomes: tuple[str, bool, str]) -> None:
    """Let slaves answer the order to reload: host, acceptance, message."""
    orders = {
        cluster.by_id(sent.host_id).name: sent.order_id for sent in cluster.sent(ReloadSettings)
    }
    for host, accepted, message in outcomes:
        cluster.tell(happened.OrderAnswered(orders[host], accepted, "", message))


def test_a_reload_applies_the_settings_of_the_core() -> None:
    """Here the needs of processes without any of their own."""
    cluster = Cluster("a").with_processes(process("p"))
    read(cluster, default_needs={"memory": 1e9})
    assert cluster.recorded("settings_reloaded") == [
        "the master: reloaded the setting default_needs"
    ]
    cluster.submit(process("q"))
    assert cluster.explain("q")["decision"]["need"] == {"memory": 1e9}


def test_a_broken_file_changes_nothing_and_no_slave_reads_its_own() -> None:
    """The reply has the fault."""
    cluster = Cluster("a")
    before = cluster.state.settings
    request = ask(cluster)
    read(cluster, request, fault="c.yaml:3:5: queue.backfill: true or false is required, not 7")
    reply = cluster.replies[request]
    assert (reply.accepted, reply.code) == (False, "invalid")
    assert reply.message.splitlines() == [
        "c.yaml:3:5: queue.backfill: true or false is required, not 7",
        "Nothing was changed, and no slave has read its file",
    ]
    assert (cluster.state.settings, cluster.sent(ReloadSettings)) == (before, [])
    assert len(cluster.recorded("reload_refused")) == 1


def test_the_reply_has_a_line_for_each_part() -> None:
    """The reply follows the last answer; a refusal of one slave refuses the request as a whole."""
    cluster = Cluster("a", "b", "c")
    cluster.cut("c", seconds=15.0)
    request = ask(cluster)
    assert [one.request for one in cluster.carried if isinstance(one, ReadSettings)] == [request]
    read(cluster, request)
    answers(cluster, ("a", True, "reloaded limits"))
    assert request not in cluster.replies
    answers(cluster, ("b", False, "h.yaml:2:1: unknown key 'limts'"))
    reply = cluster.replies[request]
    assert reply.message.splitlines() == [
        "the master: no setting to reload has changed",
        "c: not reloaded: its slave does not report",
        "a: reloaded limits",
        "b: not reloaded: h.yaml:2:1: unknown key 'limts'",
    ]
    assert (reply.accepted, reply.code) == (False, "invalid")


def test_only_one_reload_is_under_way() -> None:
    """A second request is refused until the first is answered."""
    cluster = Cluster("a")
    first = ask(cluster)
    assert cluster.ask(happened.ReloadRequested).message == (
        "the settings are being reloaded already"
    )
    read(cluster, first)
    answers(cluster, ("a", True, "reloaded labels"))
    assert isinstance(cluster.replies[first], Reply)
    second = ask(cluster)
    read(cluster, second)
    assert second not in cluster.replies


def test_other_weights_of_the_policy_decide_the_next_placement() -> None:
    """The policy is made again with the new options."""
    busy = {"memory": 0.0, "cpu": 0.5}, {"memory": 0.5, "cpu": 0.0}
    cluster = Cluster(Machine("a", busy=busy[0]), Machine("b", busy=busy[1]))

    def chain_of(chain: Sequence[PolicySettings]) -> tuple[ScoringLink, ...]:
        return tuple(ScoringLink(one.name, Eq1(**one.options), one.weight) for one in chain)

    cluster.state.chain_of = chain_of
    cluster.submit(process("p"))
    assert cluster.where("p") == ["a"]
    cluster.tell(
        happened.SettingsRead(
            0, settings=cluster.state.settings,
            scoring=(PolicySettings("eq1", 1.0, {"memory": 0.0, "cpu": 1.0}),),
            changed=("scoring",),
        )
    )  # fmt: skip
    cluster.submit(process("q"))
    assert cluster.where("q") == ["b"]


def test_a_slave_that_registers_again_may_have_other_labels() -> None:
    """A process that was set aside returns to the queue; running ones stay."""
    cluster = Cluster(Machine("a", labels={"arm": "no"}))
    cluster.submit(process("p"), process("q", required_labels={"arm": "yes"}))
    assert cluster.phase("q") == "set_aside"
    cluster.machines["a"].labels = {"arm": "yes"}
    cluster.register(cluster.machines["a"])
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.where("q")) == (["a"], ["a"])
    assert cluster.recorded("host_changed") == ["a has other labels: arm=yes"]


def test_a_slave_that_registers_again_with_the_same_description_changes_nothing() -> None:
    """Otherwise each lost answer would be recorded as a change."""
    cluster = Cluster(Machine("a", labels={"arm": "no"}))
    cluster.register(cluster.machines["a"])
    assert cluster.recorded("host_changed") == []


def test_a_slave_whose_probe_is_created_late_describes_its_resources_again() -> None:
    """Until then the host gets no work; its processes stay, and are reserved for as before."""
    machine = Machine("a", memory=16 * GIB)
    cluster = Cluster(machine)
    cluster.submit(process("p", needs={"memory": 4 * GIB}))
    real, column = machine.resources, cluster.state.hosts.by_name["a"].column

    def reserved() -> list[float]:
        table = cluster.state.hosts
        return [float(table.load[table.resources.index(one), column]) for one in ("memory", "cpu")]

    before = reserved()
    machine.resources = (real[1], ResourceDescription("memory", "1", 1.0, "unknown"))
    machine.busy["memory"] = 1.0
    machine.stale = {"memory"}
    machine.connected = False
    cluster.wait(3.0)
    assert cluster.restart_slave("a").accepted
    cluster.submit(process("q", needs={"memory": GIB}))
    cluster.wait(5.0)
    assert (cluster.where("p"), cluster.where("q")) == (["a"], [])

    machine.resources, machine.stale = real, set()
    machine.busy["memory"] = 0.1
    cluster.register(machine)
    cluster.wait(3.0)
    assert (cluster.where("p"), cluster.where("q")) == (["a"], ["a"])
    assert cluster.recorded("host_changed") == ["a has other resources: memory, cpu"]
    cluster.cancel("q")
    cluster.wait(3.0)
    assert reserved() == before


def test_a_slave_whose_launcher_is_created_late_gets_the_work_that_needs_it() -> None:
    """The process waited, because no host had its launcher."""
    cluster = Cluster(Machine("a"))
    description = replace(cluster.state.hosts.by_name["a"].description, launchers=("podman",))
    cluster.submit(process("p", container=Container("image", "podman")))
    assert cluster.where("p") == []
    cluster.request(happened.HostRegistered(0, description, (), ()))
    cluster.ask_for_work(cluster.machines["a"])
    cluster.wait(3.0)
    assert cluster.where("p") == ["a"]
    assert cluster.recorded("host_changed") == ["a has other launchers: podman"]
