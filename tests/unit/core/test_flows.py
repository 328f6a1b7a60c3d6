"""Flows between processes: limits of links, the load of links, and what `explain` says of both."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm import BoolArray, HostView, ProcessView, Scores
from rosrm.core.master.assignment.demands import demand_of, ranking_of
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.scheduling.traffic import flow_view, keeping_limits
from rosrm.core.master.state.demand import Flow, Traffic
from rosrm.core.master.state.links import Crossing, LinkTable
from rosrm.extensions.placement import ScoringLink, SelectedFilter
from rosrm.model.links import Interface
from rosrm.model.values import ProcessSpec
from rosrm_scoring.network import Network, NetworkOptions
from tests.unit.core.cluster import MIB, Cluster, Machine, movable, process

MB = 1e6
CAMERA = "20 MB/s from camera on robot-1 would cross a 5 MB/s link"


def machine(name: str, memory: float = 0.1, **fields: object) -> Machine:
    return Machine(
        name,
        memory=1000 * MIB,
        busy={"memory": memory, "cpu": 0.05},
        labels={"name": name},
        **fields,
    )


def wire(cluster: Cluster, rate: dict[str, float], *, limit: float = 1.0) -> None:
    """Report one interface of each host, by its rate in MB/s, towards all others."""
    table = cluster.state.hosts
    for name, its_rate in rate.items():
        peers = {table.by_name[other].column: (0, 0.01) for other in rate if other != name}
        table.links.store(table.by_name[name].column, [Interface(its_rate * MB)], limit, peers)
    table.changed()


def cluster_of(
    rate: dict[str, float], *specs: ProcessSpec, limit: float = 1.0, **settings: object
) -> Cluster:
    cluster = Cluster(*map(machine, rate), **settings)
    wire(cluster, rate, limit=limit)
    return cluster.with_processes(*specs)


def on(host: str, name: str, **fields: object) -> ProcessSpec:
    return process(name, required_labels={"name": host}, **fields)


def reasons(cluster: Cluster, name: str) -> dict[str, str]:
    return {one["name"]: one["reason"] for one in cluster.explain(name)["decision"]["hosts"]}


def verdicts(cluster: Cluster, name: str) -> dict[str, str]:
    return {one["name"]: one["verdict"] for one in cluster.explain(name)["decision"]["hosts"]}


# --- limits of links --------------------------------------------------------------------------


def test_a_host_behind_a_link_that_cannot_carry_the_flow_is_excluded() -> None:
    """The reason names the flow, the host of the other process and the rate of the link."""
    cluster = cluster_of({"robot-1": 5, "base": 100}, on("robot-1", "camera"))
    cluster.machines["robot-1"].busy["memory"] = 0.6
    cluster.read()
    cluster.submit(process("detector", talks_to={"camera": 20 * MB}))
    assert cluster.where("detector") == ["robot-1"]
    assert verdicts(cluster, "detector")["base"] == "excluded"
    assert reasons(cluster, "detector")["base"] == CAMERA


def test_a_flow_that_fits_does_not_decide_with_a_policy_that_reads_no_flows() -> None:
    """The link alone excludes no host."""
    cluster = cluster_of({"robot-1": 5, "base": 100}, on("robot-1", "camera"))
    cluster.machines["robot-1"].busy["memory"] = 0.6
    cluster.read()
    cluster.submit(process("detector", talks_to={"camera": 4 * MB}))
    assert cluster.where("detector") == ["base"]


def test_the_limit_of_a_link_leaves_a_part_of_its_rate_free() -> None:
    """The reason shows how much may be used."""
    cluster = cluster_of({"robot-1": 5, "base": 100}, on("robot-1", "camera"), limit=0.5)
    cluster.machines["robot-1"].busy["memory"] = 0.6
    cluster.read()
    cluster.submit(process("detector", talks_to={"camera": 4 * MB}))
    assert cluster.where("detector") == ["robot-1"]
    assert reasons(cluster, "detector")["base"] == (
        "4 MB/s from camera on robot-1 would cross a 5 MB/s link (2.5 MB/s may be used)"
    )


def test_flows_on_one_link_add_up() -> None:
    """The first flow takes the room of the second one, also towards another host."""
    cluster = cluster_of({"robot-1": 5, "base": 100, "other": 100}, on("robot-1", "camera"))
    cluster.submit(on("base", "first", talks_to={"camera": 3 * MB}))
    cluster.submit(process("second", talks_to={"camera": 3 * MB}))
    assert cluster.where("second") == ["robot-1"]
    assert reasons(cluster, "second")["other"] == (
        "3 MB/s from camera on robot-1 would cross a 5 MB/s link (3 MB/s in use)"
    )


def test_measured_traffic_takes_room_of_a_link_and_is_not_counted_twice() -> None:
    """Traffic that includes a known flow counts once: the greater one of both is the load."""
    cluster = cluster_of({"robot-1": 10, "base": 100}, on("robot-1", "camera"))
    cluster.submit(on("base", "first", talks_to={"camera": 4 * MB}))
    links, at = cluster.state.hosts.links, cluster.state.hosts.by_name
    robot, base = at["robot-1"].column, at["base"].column
    links.store(robot, [Interface(10 * MB, traffic=4 * MB)], 1.0, {base: (0, 0.01)})
    cluster.submit(on("base", "second", talks_to={"camera": 5 * MB}))
    assert cluster.where("second") == ["base"]
    links.store(robot, [Interface(10 * MB, traffic=9.5 * MB)], 1.0, {base: (0, 0.01)})
    cluster.state.hosts.changed()
    cluster.submit(on("base", "third", talks_to={"camera": 1 * MB}))
    assert cluster.phase("third") == "queued"


def test_two_flows_of_one_process_share_its_interface() -> None:
    """Each alone would fit."""
    cluster = cluster_of({"a": 5, "b": 100, "c": 100}, on("b", "one"), on("c", "two"))
    cluster.submit(on("a", "both", talks_to={"one": 3 * MB, "two": 3 * MB}))
    assert cluster.phase("both") == "set_aside"
    assert "3 MB/s from one on b would cross a 5 MB/s link (3 MB/s for other flows of it)" in (
        cluster["both"].reason
    )


def test_a_link_that_was_not_measured_excludes_no_host() -> None:
    """NaN stands for: not known."""
    cluster = Cluster(machine("a"), machine("b")).with_processes(on("a", "camera"))
    cluster.submit(on("b", "detector", talks_to={"camera": 1e15}))
    assert cluster.where("detector") == ["b"]


def test_a_process_waits_for_room_on_a_link_as_for_room_on_a_host() -> None:
    """The process keeps its place in the queue, and starts when the link has room."""
    cluster = cluster_of({"a": 5, "b": 100}, on("a", "camera"))
    cluster.submit(on("b", "first", talks_to={"camera": 4 * MB}))
    cluster.submit(on("b", "second", talks_to={"camera": 4 * MB}), process("third"))
    assert [cluster.phase(name) for name in ("second", "third")] == ["queued", "queued"]
    cluster.cancel("first")
    cluster.wait(1.0)
    assert cluster.where("second") == ["b"]


def test_a_process_takes_its_own_flow_along_when_it_moves() -> None:
    """Its flow is a part of the load now, and is not in its own way at the destination."""
    cluster = cluster_of({"a": 5, "b": 100, "c": 100}, on("a", "camera"))
    cluster.submit(movable("viewer", preferred_labels={"name": "b"}, talks_to={"camera": 4 * MB}))
    assert cluster.where("viewer") == ["b"]
    assert cluster.migrate("viewer", "c").accepted
    cluster.wait(5.0)
    assert cluster.where("viewer") == ["c"]
    assert cluster.state.hosts.links.flowing.max() == pytest.approx(4 * MB)


# --- flows that do not count ------------------------------------------------------------------


def test_a_flow_to_a_process_that_does_not_exist_does_not_count_until_both_run() -> None:
    """The process starts at once, and `explain` says why the flow does not count."""
    cluster = cluster_of({"robot-1": 5, "base": 100})
    cluster.submit(on("base", "detector", talks_to={"camera": 20 * MB}))
    assert cluster.where("detector") == ["base"]
    (flow,) = cluster.explain("detector")["flows"]
    assert (flow["process"], flow["host"], flow["reason"]) == ("camera", "", "does not exist")
    cluster.submit(process("camera", preferred_labels={"name": "robot-1"}))
    assert cluster.where("camera") == ["base"]
    assert reasons(cluster, "camera")["robot-1"] == (
        "20 MB/s to detector on base would cross a 5 MB/s link"
    )
    (flow,) = cluster.explain("detector")["flows"]
    assert (flow["host"], flow["reason"]) == ("base", "")


def test_an_explanation_has_the_largest_flows_and_counts_the_others() -> None:
    """A process may exchange data with all others, and an answer has a bound."""
    cluster = Cluster(machine("a"))
    cluster.submit(process("hub", talks_to={f"p{number}": float(number) for number in range(100)}))
    explained = cluster.explain("hub")
    assert [one["rate"] for one in explained["flows"]] == [float(99 - n) for n in range(64)]
    assert explained["flows_omitted"] == 36


def test_an_ended_process_takes_no_room_of_a_link() -> None:
    """The flows that an ended process declares do not count, either."""
    cluster = cluster_of({"a": 5, "b": 100}, on("a", "camera"))
    cluster.submit(on("b", "first", talks_to={"camera": 4 * MB}))
    cluster.cancel("first")
    cluster.submit(on("b", "second", talks_to={"camera": 4 * MB}))
    assert cluster.where("second") == ["b"]
    cluster.cancel("camera", "second")
    cluster.submit(process("other"))
    assert not cluster.state.hosts.links.crossings
    assert not cluster.state.flows.partners


# --- the policy -------------------------------------------------------------------------------


def networked(rate: dict[str, float], *specs: ProcessSpec) -> Cluster:
    policy = Network(NetworkOptions())
    cluster = Cluster(*map(machine, rate), policy=policy, reads=("talks_to",))
    wire(cluster, rate)
    return cluster.with_processes(*specs)


def test_the_policy_network_places_a_process_where_its_flow_comes_from() -> None:
    """`explain` shows the sentence for the other host."""
    cluster = networked({"base": 100, "robot-1": 100}, on("robot-1", "camera"))
    cluster.submit(process("detector", talks_to={"camera": 20 * MB}))
    assert cluster.where("detector") == ["robot-1"]
    assert reasons(cluster, "detector")["base"].endswith(
        "20 MB/s from camera on robot-1 would cross a 100 MB/s link"
    )


def test_the_policy_network_prefers_the_emptier_link() -> None:
    """If no host keeps the flow local, the policy prefers the link with more room."""
    cluster = networked({"robot": 100, "slow": 20, "fast": 90}, on("robot", "camera"))
    cluster.set_host("robot", "cordon")
    cluster.submit(process("detector", talks_to={"camera": 10 * MB}))
    assert cluster.where("detector") == ["fast"]


def test_without_flows_the_policy_network_takes_the_host_with_the_fewest_processes() -> None:
    """Each score is 0."""
    cluster = networked({"a": 10, "b": 10}, process("p0"), process("p1"))
    assert cluster.where("p0") != cluster.where("p1")
    scores = [one["score"] for one in cluster.explain("p1")["decision"]["hosts"]]
    assert scores == [0.0, 0.0]


def test_equal_processes_with_flows_are_each_placed_by_the_load_of_the_moment() -> None:
    """A shared ranking would place all of them on the first host."""
    cluster = networked({"a": 100, "b": 10, "c": 10}, on("a", "camera"))
    cluster.set_host("a", "cordon")
    specs = [process(f"v{n}", talks_to={"camera": 4 * MB}) for n in range(4)]
    cluster.submit(*specs)
    hosts = [cluster.where(spec.name)[0] for spec in specs]
    assert sorted(hosts) == ["b", "b", "c", "c"]


class Asked:
    """Scores by the reading of memory; remembers for how many hosts it was asked at once."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        self.sizes.append(len(hosts.usage))
        return Scores(hosts.column("memory") * 10)


class Loud:
    """A filter that excludes the hosts where a flow would be local."""

    def mask(self, hosts: HostView, process: ProcessView) -> BoolArray:
        return np.broadcast_to(~process.flows.is_local.any(axis=1), len(hosts.usage)).copy()

    def reason(self, hosts: HostView, process: ProcessView, row: int) -> str:
        return "a flow would be local"


NETWORK = ScoringLink("network", Network(NetworkOptions()), 0.5, ("talks_to",))


def test_only_what_reads_flows_is_asked_again_about_a_process_with_flows() -> None:
    """The other policies of a chain score all hosts once for processes with equal needs."""
    asked = Asked()
    rate = {"a": 100.0, **{f"h{number}": 10.0 for number in range(20)}}
    cluster = Cluster(*map(machine, rate), chain=(ScoringLink("asked", asked), NETWORK))
    wire(cluster, rate)
    cluster.submit(on("a", "camera"))
    asked.sizes.clear()
    cluster.submit(*(process(f"v{n}", talks_to={"camera": 1 * MB + n}) for n in range(5)))
    assert asked.sizes.count(len(rate)) == 1


def test_a_shared_ranking_with_flows_beside_it_decides_as_one_of_the_process_alone() -> None:
    """Scores, vetoes and filters that read flows are the same in both, after any assignments."""
    chance = np.random.default_rng(5)
    rate = {name: float(chance.integers(5, 100)) for name in "abcdef"}
    filters = (SelectedFilter("loud", Loud(), reads=("talks_to",)),)
    chain = (NETWORK, ScoringLink("asked", Asked()))
    cluster = Cluster(*map(machine, rate), chain=chain, filters=filters)
    wire(cluster, rate)
    compared = 0
    for turn in range(40):
        others = chance.choice(turn + 1, min(turn, 3), replace=False)
        flows = {f"p{one}": float(chance.integers(1, 9)) * MB for one in others}
        cluster.submit(process(f"p{turn}", memory=float(turn % 3 + 1), talks_to=flows))
        demand = demand_of(cluster.state, cluster[f"p{turn}"])
        shared = ranking_of(cluster.state, demand)
        assert np.allclose(shared.value, Ranking(cluster.state.hosts, demand).value)
        compared += bool(demand.traffic.flows and np.isfinite(shared.value).any())
    assert compared > 10


def test_the_fallback_decides_if_a_policy_that_reads_flows_fails() -> None:
    """The shared ranking has no policy then, and the decision names the failure."""

    class Broken:
        def score(self, hosts: HostView, process: ProcessView) -> Scores:
            raise RuntimeError("out of order")

    chain = (ScoringLink("broken", Broken(), reads=("talks_to",)),)
    fallback = ("asked", Asked())
    cluster = Cluster(machine("a", 0.3), machine("b", 0.2), chain=chain, fallback=fallback)
    cluster.submit(process("camera"))
    cluster.submit(process("viewer", talks_to={"camera": 1 * MB}))
    assert cluster.where("viewer") == ["b"]
    policy = cluster.explain("viewer")["decision"]["policy"]
    assert policy.startswith("asked (left out: 'broken'"), policy


def test_a_restarted_master_knows_the_declared_flows() -> None:
    """Flows follow from the specs in the journal."""
    cluster = cluster_of({"a": 5, "b": 100}, on("a", "camera"))
    cluster.submit(on("b", "first", talks_to={"camera": 4 * MB}))
    cluster.restart_master()
    wire(cluster, {"a": 5, "b": 100})
    cluster.submit(on("b", "second", talks_to={"camera": 4 * MB}))
    assert cluster.phase("second") == "queued"


def test_the_load_of_links_equals_the_sum_over_all_flows() -> None:
    """After any number of starts, moves and ends, nothing is left over."""
    chance = np.random.default_rng(3)
    cluster = cluster_of({"a": 100, "b": 100, "c": 100}, cooldown=0.0)
    names = [f"p{n}" for n in range(6)]
    for turn in range(60):
        name, other = (str(one) for one in chance.choice(names, 2, replace=False))
        process_now = cluster.state.processes.get(name)
        if process_now is None or process_now.phase.is_terminal:
            cluster.submit(movable(name, talks_to={other: float(chance.integers(1, 9))}))
        elif turn % 3:
            cluster.migrate(name)
        else:
            cluster.cancel(name)
        cluster.wait(1.0)
    cluster.submit(process("last", talks_to={"p0": 1.0}))
    cluster.explain("last")
    links, expected = cluster.state.hosts.links, 0.0
    for (one, two), crossing in links.crossings.items():
        assert cluster.where(one) != cluster.where(two)
        assert crossing.rate == cluster.state.flows.between(one, two).rate
        expected += 2 * crossing.rate
    assert links.flowing.sum() == pytest.approx(expected)


@given(st.data())
def test_mask_and_view_agree_on_the_hosts_within_limits(data: st.DataObject) -> None:
    """The fast mask over all hosts is what the view says of each host."""
    hosts = data.draw(st.integers(2, 6))
    links, number = LinkTable(), st.integers(0, hosts - 1)
    for column in data.draw(st.lists(number, unique=True)):
        peers = data.draw(st.dictionaries(number.filter(lambda one, own=column: one != own),
                                          st.tuples(st.integers(0, 1), st.just(0.01))))  # fmt: skip
        rates = data.draw(
            st.lists(st.sampled_from([2.0, 5.0, float("nan")]), min_size=2, max_size=2)
        )
        carried = [Interface(rate, data.draw(st.sampled_from([0.0, 1.0]))) for rate in rates]
        links.store(column, carried, data.draw(st.sampled_from([0.5, 1.0])), peers)
    rate = st.sampled_from([0.5, 1.0, 3.0])
    flow = st.builds(
        lambda at, much, learned: Flow("q", f"h{at}", at, much, True, learned),
        number, rate, st.booleans(),
    )  # fmt: skip
    flows = tuple(data.draw(st.lists(flow, min_size=1, max_size=4)))
    counted = []
    for pair in range(data.draw(st.integers(0, 3))):
        here, there = data.draw(st.tuples(number, number).filter(lambda two: two[0] != two[1]))
        links.note(pair, Crossing(here, there, data.draw(rate)))
        counted += [links.crossings[pair]] * data.draw(st.booleans())
    traffic, empty = Traffic(flows, tuple(counted)), data.draw(st.booleans())
    mask = keeping_limits(links, traffic, hosts, empty=empty)
    view = flow_view(links, traffic, np.arange(hosts), empty=empty)
    expected = ~view.is_over().any(axis=1)
    assert expected.tolist() == ([True] * hosts if mask is None else mask.tolist())
    for row, over in zip(*np.nonzero(view.is_over()), strict=True):
        assert "would cross" in view.describe(int(row), int(over))
