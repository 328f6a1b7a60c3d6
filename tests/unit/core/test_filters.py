"""Placement filters: mask, reason, ranking and explanation agree."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rosrm.core.master.scheduling.candidates import as_if_empty, candidates
from rosrm.core.master.scheduling.decision import decide
from rosrm.core.master.scheduling.feasibility import why_never
from rosrm.core.master.scheduling.filters import FILTERS, passing, refusals
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.hosts import HostCondition, HostTable
from rosrm.extensions.declared_fields import declared_spec
from rosrm.extensions.placement import PlacementPlugins, SelectedFilter
from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.values import (
    HostDescription,
    InstanceId,
    Limits,
    ProcessSpec,
    ResourceDescription,
)

RESOURCES = ("memory", "cpu", "gpu")

fractions = st.sampled_from([0.0, 0.1, 0.3, 0.5, 0.8])
amounts = st.dictionaries(
    st.sampled_from([*RESOURCES * 4, "unknown"]), st.sampled_from([0.0, 1.0, 2.0, 9.0]), max_size=2
)
labels = st.dictionaries(st.just("arm"), st.sampled_from(["yes", "no"]), max_size=1)
resources = st.sampled_from([RESOURCES, RESOURCES[:2], RESOURCES[1:], ()]).map(
    lambda names: tuple(ResourceDescription(name, "", 10.0) for name in names)
)
devices = st.lists(
    st.builds(
        Device, st.sampled_from(["gpu", "camera"]), st.sampled_from("012"),
        shareable=st.sampled_from([1, 1, 3]), missing=st.sampled_from(["", "", "", "gone"]),
    ),
    max_size=4, unique_by=lambda one: (one.kind, one.unit),
).map(tuple)  # fmt: skip
device_needs = st.lists(
    st.one_of(
        st.builds(
            DeviceNeed, st.sampled_from(["gpu", "camera"]), st.sampled_from([0.4, 0.5, 1.0, 2.0])
        ),
        st.builds(DeviceNeed, st.just("gpu"), st.just(1.0), st.sampled_from([("0",), ("1",)])),
    ),
    max_size=2, unique_by=lambda need: need.kind,
).map(tuple)  # fmt: skip
conditions = st.sampled_from([HostCondition.UP] * 9 + [*HostCondition])
rarely = st.sampled_from([False] * 7 + [True])
usually = st.sampled_from([True] * 7 + [False])


class Armed:
    """Filter of a plugin by a label."""

    def mask(self, hosts, process):
        return ~hosts.labelled("arm", "no")

    def reason(self, hosts, process, row):
        return "it has no arm"


class Idle:
    """Filter of a plugin by what assignments change."""

    def mask(self, hosts, process):
        return hosts.processes < 2

    def reason(self, hosts, process, row):
        return f"it runs {hosts.processes[row]} processes"


class Broken(Armed):
    """Filter of a plugin that fails."""

    def mask(self, hosts, process):
        raise RuntimeError("out of order")


filters_of_plugins = st.sampled_from(
    [
        (),
        (SelectedFilter("armed", Armed(), permanent=True),),
        (SelectedFilter("idle", Idle()), SelectedFilter("armed", Armed())),
        (SelectedFilter("broken", Broken(), permanent=True),),
    ]
)


@st.composite
def tables(draw: st.DrawFn, most: int = 20) -> HostTable:
    """Draw hosts in any state that the master may know."""
    table = HostTable()
    for number in range(draw(st.integers(1, most))):
        name = f"h{number}"
        if draw(rarely):
            table.expect(name, cordoned=draw(rarely))
            continue
        described = draw(resources)
        description = HostDescription(
            name, number + 1, labels=draw(labels), resources=described,
            max_processes=draw(st.sampled_from([0, 1, 2])),
            unenforced={"limits.cpu": "no group"} if draw(rarely) else {},
            cpus=draw(st.sampled_from([(), (0, 1), (0, 1, 2, 3)])),
            devices=draw(devices),
        )  # fmt: skip
        host = table.register(description, 0.0)
        column = host.column
        for resource in described:
            row = table.resources.index(resource.name)
            table.usage[row, column] = draw(fractions)
            table.limit[row, column] = draw(st.sampled_from([0.5, 0.8, 1.0]))
        np.add(table.usage, table.load, out=table.busy)
        table.sequence[column] = draw(usually)
        table.accepting[column], table.asking[column] = draw(usually), draw(usually)
        table.report_due[column] = draw(rarely)
        table.stale[column] = 1 if described and draw(rarely) else 0
        table.set_closed(host, cordoned=draw(rarely), draining=draw(rarely))
        table.set_condition(host, draw(conditions))
        load = np.array([draw(fractions) / 4 for _ in table.resources])
        table.add_reservation(host, load, processes=draw(st.sampled_from([0, 0, 1])))
        inventory = table.devices[column]
        for other in draw(device_needs):
            held = inventory.choose((other,))
            table.hold(host, InstanceId("other", number), held or ())
        if draw(rarely):
            table.prune(host)
    table.set_claims({0: draw(st.integers(0, 2))} if draw(rarely) else {})
    return table


@st.composite
def demands(draw: st.DrawFn) -> Demand:
    needs: Mapping[str, float] = draw(amounts)
    estimated = frozenset(name for name in needs if draw(st.booleans()))
    excluded = draw(st.dictionaries(st.sampled_from(["h0", "h1", "h2"]), st.just("no"), max_size=1))
    required = draw(labels) if draw(rarely) else {}
    limits = Limits(cpu=1.0, enforce=draw(st.sampled_from(["preferred", "required"])))
    spec = ProcessSpec(
        "p", command=("run",), required_labels=required, limits=limits,
        cpus=draw(st.sampled_from([(), (1,), (1, 3)])), priority=draw(st.integers(0, 2)),
        devices=draw(device_needs),
    )  # fmt: skip
    read = declared_spec(spec, ())  # a filter may read only what makes rankings differ
    plugins = PlacementPlugins(filters=draw(filters_of_plugins))
    headroom = draw(st.sampled_from([0.0, 0.05]))
    return Demand(read, needs, estimated, excluded, headroom, plugins=plugins)


def ranked(table: HostTable, demand: Demand) -> Ranking:
    return Ranking(table, demand)


def test_no_two_filters_have_one_name() -> None:
    """A name stands for one filter."""
    assert len({one.name for one in FILTERS}) == len(FILTERS)


@given(tables(), demands())
def test_a_host_fits_exactly_if_no_filter_has_a_reason_against_it(
    table: HostTable, demand: Demand
) -> None:
    """Ranking and explanation use the same list of filters."""
    ranking = ranked(table, demand)
    every = candidates(table, demand, ranking.need, slice(0, len(table)))
    found = refusals(FILTERS, every)

    assert [ranking.fits(column) for column in range(len(table))] == [one is None for one in found]
    verdicts = {one.host: one for one in decide(ranking).verdicts}
    for host in table.listed():
        refusal, verdict = found[host.column], verdicts.get(host.name)
        if verdict is not None and refusal is not None:
            assert (verdict.verdict, verdict.reason) == (refusal.filter.verdict, refusal.reason)


@given(tables(), demands(), st.booleans())
def test_every_filter_that_excludes_a_host_has_a_reason(
    table: HostTable, demand: Demand, as_empty: bool
) -> None:
    """Reason and mask agree for all hosts, for some hosts, and for hosts taken as empty."""
    need = table.fractions(demand.amounts, demand.estimated)
    columns = np.arange(len(table))[::-2]
    if as_empty:
        every = as_if_empty(table, demand, slice(0, len(table)))
        some = as_if_empty(table, demand, columns)
    else:
        every = candidates(table, demand, need, slice(0, len(table)))
        some = candidates(table, demand, need, columns)
    for one in FILTERS:
        mask = passing([one], every)
        assert passing([one], some).tolist() == mask[columns].tolist()
        for row in np.flatnonzero(~mask):
            if passing(FILTERS[: FILTERS.index(one)], every)[row]:
                assert one.reason(every, int(row))


@given(tables(most=3), demands(), st.lists(st.integers(0, 19), min_size=1, max_size=6))
def test_a_refreshed_ranking_equals_a_new_one(
    table: HostTable, demand: Demand, chosen: list[int]
) -> None:
    """The ranking stays correct after assignments of the same demand and of other demands."""
    ranking = ranked(table, demand)
    for number in chosen:
        fitting = [host for host in table.hosts if ranking.fits(host.column)]
        host = (fitting or table.hosts)[number % len(fitting or table.hosts)]
        own = bool(fitting) and number % 3 > 0
        need = ranking.need[:, host.column] if own else np.full(len(table.resources), 0.1)
        if own:
            held = table.devices[host.column].choose(demand.spec.devices)
            assert held is not None
            table.hold(host, InstanceId("own", len(table.touched)), held)
        table.add_reservation(host, need, processes=1)
        if own:
            ranking.note_assignment()
        ranking.refresh()
        new = ranked(table, demand)
        assert ranking.value.tolist() == new.value.tolist()
        assert (ranking.lowest(), ranking.fitting()) == (new.lowest(), new.fitting())


@given(tables(most=3), demands(), st.data())
def test_a_ranking_after_new_readings_equals_a_new_one(
    table: HostTable, demand: Demand, data: st.DataObject
) -> None:
    """Needs and filters that readings do not change are kept; all others are computed again."""
    ranking = ranked(table, demand)
    for host in table.hosts:
        column = host.column
        table.usage[:, column] *= data.draw(fractions)
        table.limit[:, column] *= data.draw(st.sampled_from([0.5, 1.0]))
        table.stale[column], table.accepting[column] = data.draw(rarely), data.draw(usually)
        table.add_reservation(host, np.full(len(table.resources), data.draw(fractions)))
    np.add(table.usage, table.load, out=table.busy)
    table.readings_changed()
    ranking.refresh()
    new = ranked(table, demand)
    assert ranking.outlasts_readings()
    assert (ranking.value.tolist(), ranking.need.tolist()) == (
        new.value.tolist(),
        new.need.tolist(),
    )
    assert decide(ranking) == decide(new)


def test_only_readings_leave_a_ranking_in_use() -> None:
    """A change of a host's labels or condition makes the filters that a ranking keeps void."""
    table = HostTable()
    host = table.register(HostDescription("a", 1), 0.0)
    ranking = ranked(table, Demand(ProcessSpec("p"), {}))
    table.set_condition(host, HostCondition.SUSPECT)
    table.readings_changed()
    assert not ranking.outlasts_readings()


@given(tables(), st.lists(device_needs, min_size=1, max_size=3), st.data())
def test_counts_of_devices_follow_every_change(
    table: HostTable, needs: list[tuple[DeviceNeed, ...]], data: st.DataObject
) -> None:
    """They are cached by needs, and equal to those of a new table."""
    for number in range(data.draw(st.integers(0, 4))):
        host = table.hosts[data.draw(st.integers(0, len(table) - 1))]
        wanted = data.draw(st.sampled_from(needs))
        before = table.devices.counts(wanted)[host.column]
        held = table.devices[host.column].choose(wanted)
        assert (held is not None) == (before > 0)
        table.hold(host, InstanceId("p", number), held or ())
        for one in needs:
            inventories = table.devices.at(slice(0, len(table)))
            assert table.devices.counts(one).tolist() == [it.count(one) for it in inventories]
            empty = [it.emptied().count(one) for it in inventories]
            assert table.devices.counts(one, empty=True).tolist() == empty


@given(tables(most=3), demands())
def test_no_process_is_set_aside_if_a_host_takes_it_now(table: HostTable, demand: Demand) -> None:
    """The reason of a process that is set aside names each host."""
    never = why_never(table, demand)
    if (ranked(table, demand).value < np.inf).any():
        assert never == ""
    if never and "no host reports" not in never and "no host has" not in never:
        assert all(host.name in never for host in table.listed())
