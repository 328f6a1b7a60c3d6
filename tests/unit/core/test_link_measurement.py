"""Measurement of links by orders to slaves, learned flows, and refused reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from rosrm.core.master.hosts.links import PROBES
from rosrm.core.master.state.flows import Flows, Partner
from rosrm.core.master.state.links import MOST_HOSTS, Crossing, LinkTable
from rosrm.model.links import Interface, LinkReport, report_from_json
from rosrm.model.orders import MeasureLinks
from tests.drawing import drawn
from tests.unit.core.cluster import Cluster, Machine, movable, node, process

MB = 1e6
SETTINGS = {"link_period": 1.0, "learn_flows": True}


def measuring(
    name: str, flows: Mapping[int, Mapping[str, float]] | None = None, **changes: Any
) -> Machine:
    """Return a host that answers each measurement: 5 MB/s, and 10 ms to each peer."""
    machine = Machine(name)

    def measure(order: MeasureLinks) -> Mapping[str, Any]:
        peers = {peer.host_id: (0, 0.01) for peer in order.peers}
        report = LinkReport(
            ("10.0.0.1",), 4000, 1.0, (Interface(5 * MB, 100.0),), peers, flows or {}
        )
        return {**report.to_json(), **changes}

    machine.measures = measure
    return machine


def orders(cluster: Cluster) -> list[tuple[str, tuple[str, ...]]]:
    """Return host and peers of each order to measure links."""
    names = {machine.host_id: name for name, machine in cluster.machines.items()}
    return [
        (names[one.host_id], tuple(peer.host for peer in one.order.peers))
        for one in cluster.sent(MeasureLinks)
    ]


def test_every_host_measures_its_links_to_all_others() -> None:
    """The address of a host is known from its first report."""
    cluster = Cluster(*map(measuring, "abc"), **SETTINGS)
    cluster.wait(8.0)
    links, off = cluster.state.hosts.links, ~np.eye(3, dtype=bool)
    assert (links.interface[:3, :3][off] == 0).all()
    assert links.round_trip[:3, :3][off] == pytest.approx(0.01)
    assert links.rate[:3, 0].tolist() == [5 * MB] * 3
    assert links.traffic[:3, 0].tolist() == [100.0] * 3
    assert set(orders(cluster)) >= {("a", ()), ("a", ("b", "c"))}


def test_measurements_of_many_hosts_are_few_packets_a_second_in_all() -> None:
    """With more hosts, each measures more seldom."""
    cluster = Cluster(*(measuring(f"h{n}") for n in range(30)), **{**SETTINGS, "link_period": 0.5})
    cluster.wait(5.0)
    before = len(orders(cluster))
    cluster.wait(10.0)
    made = orders(cluster)[before:]
    assert len(made) <= 10.0 / 0.2 + 1
    assert sum(len(peers) for _, peers in made) <= 10.0 * (PROBES + 1) + 4


def test_a_host_that_refuses_to_measure_is_asked_again_with_back_off() -> None:
    """Its slave may refuse for a moment only; the measurements of others are not delayed."""
    cluster = Cluster("a", measuring("b"), **SETTINGS)
    cluster.wait(20.0)
    asked = [host for host, _ in orders(cluster)]
    assert 3 <= asked.count("a") <= 6
    assert asked.count("b") >= 15
    cluster.machines["a"].measures = measuring("a").measures
    cluster.wait(40.0)
    assert [host for host, _ in orders(cluster)].count("a") >= 15


def test_a_lost_host_is_not_measured() -> None:
    """The others have no order to measure the link to it, and it has none."""
    cluster = Cluster(measuring("a"), measuring("b"), **SETTINGS, lease=2.0)
    cluster.wait(4.0)
    cluster.cut("b", seconds=4.0)
    before = len(orders(cluster))
    cluster.wait(3.0)
    assert set(orders(cluster)[before:]) == {("a", ())}


def test_the_links_of_a_slave_that_starts_again_are_measured_anew() -> None:
    """Its interfaces may have other numbers now."""
    cluster = Cluster(measuring("a"), measuring("b"), **SETTINGS)
    cluster.wait(5.0)
    cluster.machines["a"].measures = None
    cluster.cut("a", seconds=2.0)
    cluster.restart_slave("a")
    links = cluster.state.hosts.links
    assert math.isnan(links.rate[0, 0])
    assert math.isnan(links.round_trip[1, 0])


def test_no_link_is_measured_with_a_period_of_0() -> None:
    """The settings `network.period: 0` turn measurements off."""
    cluster = Cluster(measuring("a"), measuring("b"), link_period=0.0)
    cluster.wait(5.0)
    assert not orders(cluster)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"interfaces": 5}, "it is malformed (TypeError)"),
        ({"peers": [1]}, "it is malformed (AttributeError)"),
        ({"limit": 2.0}, "the limit is 2.0; allowed: 0 to 1"),
        ({"addresses": ["10.0.0.256"]}, "it has an impossible address or port"),
        ({"addresses": ["example.org"]}, "it has an impossible address or port"),
        ({"port": 70000}, "it has an impossible address or port"),
        ({"port": None}, "it has an impossible address or port"),
    ],
)
def test_an_impossible_report_is_refused_as_a_whole(changes: dict[str, Any], why: str) -> None:
    """The refusal is recorded with the value, and nothing changes."""
    cluster = Cluster(measuring("a", **changes), measuring("b"), **SETTINGS)
    cluster.wait(3.0)
    refused = cluster.recorded("reading_refused")
    assert refused
    assert refused[0].startswith("a report of a on its links was refused: ")
    assert why in refused[0]
    assert np.isnan(cluster.state.hosts.links.rate[0]).all()


GOOD = Interface(5 * MB, 100.0)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"interfaces": [[math.nan, 0.0]]}, "a link rate is nan; allowed: 0 to 1e+15"),
        ({"interfaces": [[-5.0, 0.0]]}, "a link rate is -5.0"),
        ({"interfaces": [[0.0, 0.0]]}, "a link rate is 0; it must be greater"),
        ({"interfaces": [["fast", 0.0]]}, "a link rate is 'fast'"),
        ({"interfaces": [[1.0, math.inf]]}, "traffic is inf"),
        ({"interfaces": [[1.0]]}, "not enough values"),
        ({"interfaces": [[1.0, 0.0]] * 9}, "it has 11 interfaces; at most 8"),
        ({"peers": {"2": [2, 0.1]}}, "interface 2 does not exist; there are 2"),
        ({"peers": {"2": [0, math.nan]}}, "a round trip is nan"),
        ({"peers": {"2": [0, 60.0]}}, "a round trip is 60.0; allowed: 0 to 10"),
        ({"peers": {"two": [0, 0.1]}}, "invalid literal"),
        ({"peers": {str(one): [0, 0.1] for one in range(10, 27)}}, "it has 18 peers; at most 16"),
        ({"flows": {"1": {"/camera": math.nan}}}, "the rate of a flow from /camera is nan"),
        ({"flows": {"1": {"/camera": 2e15}}}, "the rate of a flow from /camera is 20000000000"),
        ({"flows": {"x": {"/camera": 1.0}}}, "invalid literal"),
        ({"flows": {"1": {f"/{one}": 1.0 for one in range(513)}}}, "it has 514 flows; at most 512"),
    ],
)  # fmt: skip
def test_an_impossible_entry_is_left_out_of_a_report(changes: dict[str, Any], why: str) -> None:
    """All others count; before, one of them discarded what the host had measured."""
    report = LinkReport(
        ("10.0.0.1",), 4000, 0.5, (GOOD, GOOD), {3: (1, 0.01)}, {7: {"/lidar": 2.0}}
    )
    plain = report.to_json()
    for key, added in changes.items():
        plain[key] = [*plain[key], *added] if key == "interfaces" else {**plain[key], **added}
    found, (fault, *_) = report_from_json(plain)
    assert why in fault
    assert GOOD in found.interfaces
    assert (found.peers[3], found.flows[7]) == ((1, 0.01), {"/lidar": 2.0})
    assert all(math.isnan(one.rate) or one.rate > 0.0 for one in found.interfaces)


def test_entries_that_are_left_out_are_counted_and_named() -> None:
    """At most once in a while for each host, because it reports every ten seconds."""
    flows = {"1": {"/x": -1.0, "/y": "fast", "/z": 1.0}}
    cluster = Cluster(measuring("a", flows=flows), **SETTINGS)
    cluster.wait(5.0)
    (line,) = cluster.recorded("reading_refused")
    assert line == (
        "2 entries left out of a report of a on its links: the rate of a flow from /x is "
        "-1.0; allowed: 0 to 1e+15; the rate of a flow from /y is 'fast'; allowed: 0 to 1e+15"
    )
    assert cluster.state.hosts.links.rate[0, 0] == 5 * MB


@given(drawn(LinkReport))
def test_any_report_is_refused_or_survives(report: LinkReport) -> None:
    """A report that is accepted as a whole is the same after JSON."""
    plain = report.to_json()
    try:
        again, faults = report_from_json(plain)
    except ValueError:
        return
    plain["flows"] = {number: flows for number, flows in plain["flows"].items() if flows}
    assert faults or again.to_json() == plain


def test_a_report_names_hosts_that_do_not_exist() -> None:
    """Unknown numbers, and the number of the host itself, are left out."""
    peers = {"1": [0, 0.1], "2": [0, 0.1], "99": [0, 0.1], "0": [0, 0.1], "-1": [0, 0.1]}
    cluster = Cluster(measuring("a", peers=peers), "b", **SETTINGS)
    cluster.wait(2.0)
    links = cluster.state.hosts.links
    assert links.round_trip[0, 1] == pytest.approx(0.1)
    assert math.isnan(links.round_trip[0, 0])


def test_a_host_beyond_the_largest_table_stays_unknown() -> None:
    """The table does not grow without a bound."""
    table = LinkTable()
    table.store(MOST_HOSTS, [Interface(1.0)], 1.0, {0: (0, 0.1)})
    table.note(("p", "q"), Crossing(0, MOST_HOSTS, 5.0))
    assert table.size == 0
    table.note(("p", "q"), None)


def test_flows_are_kept_when_the_table_grows_and_interfaces_change() -> None:
    """The sum belongs to the interfaces that the flows cross now."""
    table = LinkTable()
    table.note(("p", "q"), Crossing(0, 1, 5.0))
    table.store(0, [Interface(10.0), Interface(20.0)], 1.0, {1: (1, 0.1)})
    assert table.flowing[0, 1] == 5.0
    table.store(0, [Interface(10.0), Interface(20.0)], 1.0, {1: (0, 0.1), 9: (1, 0.1)})
    assert (table.flowing[0, 0], table.flowing[0, 1]) == (5.0, 0.0)
    table.note(("p", "q"), None)
    assert not table.flowing.any()


# --- learned flows ----------------------------------------------------------------------------


def learned(cluster: Cluster, name: str) -> dict[str, float]:
    return {one["process"]: one["rate"] for one in cluster.explain(name)["flows"]}


def test_flows_between_nodes_are_learned_by_their_processes() -> None:
    """Nodes of no process are left out, and so is the process's own node."""
    flows: dict[int, dict[str, float]] = {}
    cluster = Cluster(measuring("a", flows), measuring("b", flows), **SETTINGS)
    cluster.submit(node("camera", namespace="/robot"), node("viewer"))
    for name in ("camera", "viewer"):
        cluster.discover(name, on=cluster.where(name)[0])
    number = cluster["viewer"].owner
    flows[number] = {"/robot/camera": 2 * MB, "/viewer": 1.0, "/foreign": 9 * MB, "/camera": 1.0}
    cluster.wait(3.0)
    assert learned(cluster, "viewer") == {"camera": 2 * MB}
    (flow,) = cluster.explain("camera")["flows"]
    assert (flow["incoming"], flow["learned"], flow["host"]) == (
        False, True, cluster.where("viewer")[0],
    )  # fmt: skip


def test_a_declared_flow_replaces_the_learned_one() -> None:
    """Whichever of the two processes declares it."""
    flows: dict[int, dict[str, float]] = {}
    cluster = Cluster(measuring("a", flows), **SETTINGS)
    cluster.submit(node("camera", talks_to={"viewer": 7.0}), node("viewer"), node("other"))
    flows[cluster["viewer"].owner] = {"/camera": 2 * MB, "/other": 3.0}
    cluster.wait(3.0)
    assert learned(cluster, "viewer") == {"camera": 7.0, "other": 3.0}


def test_a_host_reports_flows_of_its_own_instances_only() -> None:
    """A report about an instance of another host, or about none, has no effect."""
    flows: dict[int, dict[str, float]] = {}
    cluster = Cluster(Machine("a"), measuring("b", flows), **SETTINGS)
    cluster.submit(
        replace(node("viewer"), preferred_labels={}), process("camera"),
    )  # fmt: skip
    on_a = next(name for name in ("viewer", "camera") if cluster.where(name) == ["a"])
    flows |= {cluster[on_a].owner: {"/viewer": 1.0, "/camera": 1.0}, 10**9: {"/viewer": 1.0}}
    cluster.wait(3.0)
    assert not cluster.state.flows.learned


def test_a_learned_flow_survives_a_restart_and_ends_with_its_process() -> None:
    """The next slave, or instance, needs minutes to measure it again."""
    flows: dict[int, dict[str, float]] = {}
    cluster = Cluster(measuring("a", flows), **SETTINGS)
    cluster.submit(node("camera"), node("viewer"))
    flows[cluster["viewer"].owner] = {"/camera": 2 * MB}
    cluster.wait(3.0)
    flows.clear()
    cluster.wait(3.0)
    assert learned(cluster, "viewer") == {"camera": 2 * MB}
    cluster.cancel("camera")
    cluster.wait(2.0)
    assert learned(cluster, "viewer") == {}


def test_a_flow_that_is_not_measured_any_more_stops_counting_after_ten_minutes() -> None:
    """Its subscription is gone, or its topic is silent; other flows of the process stay."""
    flows: dict[int, dict[str, float]] = {}
    cluster = Cluster(measuring("a", flows), **SETTINGS)
    cluster.submit(node("camera"), node("lidar"), node("viewer"), node("logger"))
    for name in ("camera", "lidar", "viewer", "logger"):
        cluster.discover(name, on="a")
    viewer, logger = cluster["viewer"].owner, cluster["logger"].owner
    flows |= {viewer: {"/camera": 2 * MB, "/lidar": 5.0}, logger: {"/camera": 3.0}}
    cluster.wait(3.0)
    flows[viewer] = {"/camera": 0.0, "/lidar": 5.0}
    del flows[logger]
    cluster.wait(590.0, tick=1.0)
    assert learned(cluster, "viewer") == {"camera": 2 * MB, "lidar": 5.0}
    assert learned(cluster, "logger") == {"camera": 3.0}
    cluster.wait(20.0, tick=1.0)
    assert learned(cluster, "viewer") == {"lidar": 5.0}
    assert learned(cluster, "logger") == {}


def test_a_learned_flow_counts_after_a_long_wait_until_it_could_be_measured_again() -> None:
    """The ten minutes begin with the assignment of the process to its next host."""
    flows = Flows()
    flows.learn("viewer", {"camera": 5.0}, now=0.0, since=0.0)
    flows.learn("viewer", {}, now=9_000.0, since=8_500.0)
    assert flows.between("viewer", "camera").rate == 5.0
    flows.learn("viewer", {}, now=9_100.0, since=8_500.0)
    assert (flows.between("viewer", "camera").rate, flows.partners) == (0.0, {})


def test_the_size_of_the_cluster_does_not_discard_what_a_host_measured() -> None:
    """A peer beyond the largest table is left out."""
    table = LinkTable()
    table.store(0, [Interface(10.0)], 1.0, {1: (0, 0.1), MOST_HOSTS: (0, 0.1)})
    assert (table.rate[0, 0], table.interface[0, 1]) == (10.0, 0)


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_a_flow_that_both_declare_is_one_flow_of_the_greater_rate(names: tuple[str, str]) -> None:
    """Seen from either side; otherwise one of them could overload a link that it shares."""
    flows = Flows()
    flows.declare("a", {"b": 10.0})
    flows.declare("b", {"a": 1.0})
    assert flows.between(*names) == Partner(10.0, names == ("a", "b"))


def test_a_learned_flow_counts_as_at_most_half_a_link() -> None:
    """Two nodes that exchange more in the memory of one host can leave it one after the other."""
    flows: dict[int, dict[str, float]] = {}
    cluster = Cluster(measuring("a", flows), measuring("b", flows), **SETTINGS)
    cluster.set_host("b", "cordon")
    cluster.submit(movable("camera", ros=True), movable("viewer", ros=True))
    for name in ("camera", "viewer"):
        cluster.discover(name, on="a")
    flows[cluster["viewer"].owner] = {"/camera": 500 * MB}
    cluster.wait(4.0)
    assert learned(cluster, "viewer") == {"camera": 500 * MB}
    cluster.set_host("b", "uncordon")
    assert cluster.migrate("viewer", "b").accepted
