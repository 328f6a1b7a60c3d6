"""Replay of a record by a core: equal settings give equal decisions, others do not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.settings import CoreSettings
from rosrm.extensions.placement import PlacementPlugins, ScoringLink
from rosrm.model.records import Intent
from rosrm.model.requester import OPERATOR, Requester
from rosrm.recording.encoding import Happened
from rosrm.recording.reader import Header, Recording
from rosrm_scoring.weighted import Weighted, WeightedOptions
from rosrm_simulate.agreement import compare
from rosrm_simulate.engine import Simulation
from rosrm_simulate.extraction import Extraction
from rosrm_simulate.replay import replay as replay_declared

from .workloads import (
    EQ1,
    MIB,
    STRATEGIES,
    declared_by,
    host,
    plan,
    read,
    recorded,
    simulation,
)


def replay(record, *, policy=EQ1, settings=None, watch=None, **options):
    """Replay a record with the strategies and settings of its run."""
    declared = declared_by(STRATEGIES)
    core = settings or CoreSettings()
    return replay_declared(record, core, policy, STRATEGIES, watch, declared=declared, **options)


BY_CPU = PlacementPlugins((ScoringLink("weighted", Weighted(WeightedOptions({"cpu": 1.0}))),))


def busy(until: float = 60.0, **options) -> Simulation:
    """Return a simulation: arrivals, a full host, growth, moves, requests, a join and a loss."""
    hosts = [host("a", 400), host("b", 400), host("c", 400, joins=6.0), host("d", leaves=20.0)]
    plans = [plan(f"p{n}", 60.0, at=0.7 * n, duration=15.0, cpu=0.5) for n in range(12)]
    plans += [plan("grows", 40.0, at=1.0, growth=20.0, most=300.0, strategy="relaunch")]
    plans += [plan("node", 30.0, at=2.0, ros=True, strategy="handoff")]
    requests = [
        (9.0, happened.MigrationRequested(0, "node")),
        (12.0, happened.HostStateRequested(0, "a", "drain")),
        (30.0, happened.CancelRequested(0, ("node", "grows"))),
    ]
    return simulation(hosts, plans, requests=requests, until=until, **options)


@pytest.fixture(scope="module")
def record() -> Recording:
    return read(recorded(busy()))


def test_its_own_settings_decide_the_same_and_give_the_same_outcome(record):
    run, again = busy().run(), replay(record)
    assert again.decisions > 20
    assert (again.different, again.differences) == (0, ())
    assert again.outcome.placements == run.placements
    assert again.outcome.ends == run.ends
    assert again.outcome.migrations == run.migrations > 0
    assert again.outcome.over_limit == pytest.approx(run.over_limit)


@settings(max_examples=15)
@given(
    loads=st.lists(
        st.tuples(st.floats(0, 20), st.floats(1, 250), st.floats(0, 3), st.floats(0.1, 30)),
        min_size=1, max_size=12,
    ),
    growth=st.sampled_from([0.0, 10.0]),
    backfill=st.booleans(),
)  # fmt: skip
def test_any_run_is_replayed_to_the_same_decisions(loads, growth, backfill):
    plans = [
        plan(f"p{n}", memory, at=at, cpu=cpu, duration=d, growth=growth, strategy="relaunch")
        for n, (at, memory, cpu, d) in enumerate(loads)
    ]
    made = simulation([host("a", 500), host("b", 500)], plans, until=40.0, backfill=backfill)
    again = replay(read(recorded(made)), settings=CoreSettings(backfill=backfill))
    assert again.different == 0


def test_where_the_journal_had_lost_its_end_the_replay_gives_no_work_either(record):
    """The replay knows the end of the journal and the host that had seen more of it."""
    told = [
        replace(one, event=replace(one.event, journal_seen=9))
        if isinstance(one.event, happened.HostRegistered)
        else one
        for one in record.events
    ]
    for newest, held_up in ((9, False), (3, True)):
        intents = {"cluster": {"tail": {"newest": newest, "fell": False}}}
        header = replace(record.header, intents=intents)
        again = replay(replace(record, header=header, events=told))
        assert (again.different > 0) is held_up


def test_other_weights_decide_otherwise_and_the_first_difference_is_told(record):
    again = replay(record, policy=BY_CPU)
    assert again.different > 0
    assert "recorded assign" in str(again.differences[0])
    assert 0.0 < again.differences[0].elapsed < 60.0


def test_a_core_that_decides_by_chance_would_be_found(record):
    """The comparison uses the recorded decisions, not those of a second replay."""
    events = list(record.events)
    at = next(n for n, one in enumerate(events) if one.decided)
    one = events[at]
    events[at] = Happened(one.now, one.wall, one.event, ("assign p0#99 to host 2",))
    tampered = Recording(record.name, record.header, tuple(events), record.end)
    again = replay(tampered)
    assert again.different == 1
    assert again.differences[0].recorded == ("assign p0#99 to host 2",)


def test_measured_up_to_a_time_a_replay_is_the_run_up_to_there(record):
    """Later events do not change its numbers; the decisions are compared to the end."""
    run = busy(until=6.5).run()
    again, whole = replay(record, until=6.5), replay(record)
    cut = again.outcome
    assert (cut.placements, cut.arrivals, cut.ends) == (run.placements, run.arrivals, run.ends)
    assert (cut.running, cut.waiting, cut.makespan) == (run.running, run.waiting, run.makespan)
    assert cut.migrations == run.migrations == 0 < whole.outcome.migrations
    assert cut.span == pytest.approx(run.span)
    assert cut.curves.times[-1] <= 6.5
    assert (again.decisions, again.different) == (whole.decisions, 0)


def test_what_runs_when_the_record_begins_is_where_it_is():
    """After a restart of the master its processes arrived at its start, on their hosts."""
    plans = [plan("p0", 100.0), plan("p1", 100.0), plan("large", 5000.0)]
    made = simulation([host("a"), host("b")], plans, until=5.0)
    tables: dict[str, dict[str, dict]] = {}
    take = made.meter.take

    def note(state, event, commands, now):
        for one in commands:
            if isinstance(one, Intent):
                tables.setdefault(one.table, {})[one.key] = one.value
        take(state, event, commands, now)

    made.meter.take = note
    before = made.run()
    header = Header("1", "test", {}, 2, 5.0, tables)
    after = replay(Recording("r", header, (), "stopped")).outcome
    assert after.placements == before.placements != {}
    assert list(after.never_placed) == ["large"]
    assert after.arrivals == {"p0": 0.0, "p1": 0.0, "large": 0.0}


def test_a_process_of_a_record_that_ended_without_a_host_is_named_with_its_reason():
    """The process is listed among those never placed, like one that still waits."""
    plans = [plan("p0", 100.0), plan("large", 900.0)]
    requests = [(3.0, happened.CancelRequested(0, ("large",)))]
    made = simulation([host("a")], plans, until=5.0, requests=requests)
    outcome = replay(read(recorded(made))).outcome
    assert outcome.never_placed == {"large": "it was cancelled"}


def test_a_workload_made_of_a_record_gives_nearly_the_same_run(record):
    """The workload is simulated, recorded, extracted and simulated again."""
    extraction = Extraction(record)
    first = replay(record, watch=extraction.watch).outcome
    workload = extraction.workload()
    second = Simulation(workload, CoreSettings(), EQ1, STRATEGIES, declared_by(STRATEGIES)).run()

    assert {one.name for one in workload.hosts} == {"a", "b", "c", "d"}
    by_name = {one.name: one for one in workload.hosts}
    assert by_name["c"].joins == pytest.approx(6.0, abs=0.1)
    assert by_name["d"].leaves == pytest.approx(20.0, abs=0.1)
    assert by_name["a"].limits["memory"] == 0.8
    assert len(workload.processes) == 14
    agreement = compare(first, second)
    assert agreement.processes == 14
    assert agreement.same_host >= 0.75
    assert agreement.ranked["memory"] < 0.06
    assert agreement.balance["memory"] < 0.08


def test_the_workload_of_a_record_has_no_denied_request():
    """The others are repeated by an operator, because its submissions have no owner."""
    root, bob = Requester("user:root", is_operator=True), Requester("user:bob")
    requests = [
        (3.0, happened.CancelRequested(0, ("p",), bob)),
        (5.0, happened.CancelRequested(0, ("p",), root)),
    ]
    made = simulation([host("a")], [plan("p", 50.0)], requests=requests, until=10.0)
    extraction = Extraction(record := read(recorded(made)))
    replay(record, watch=extraction.watch)
    ((at, repeated),) = extraction.workload().requests
    assert (at, repeated.by) == (pytest.approx(5.0, abs=0.1), OPERATOR)


def test_what_hands_over_keeps_its_age_in_the_workload_made_of_it():
    """A process that grows for 20 s and moves after 10 s has the curve of a single process."""
    move = (10.0, happened.MigrationRequested(0, "node"))
    grows = plan("node", 50.0, growth=10.0, most=250.0, ros=True, strategy="handoff")
    made = simulation([host("a"), host("b")], [grows], requests=[move], until=30.0)
    extraction = Extraction(record := read(recorded(made)))
    assert replay(record, watch=extraction.watch).outcome.migrations
    (found,) = extraction.workload().processes
    seen = [found.memory.at(age) / MIB for age in (2.0, 8.0, 14.0, 25.0)]
    assert seen == pytest.approx([70.0, 130.0, 190.0, 250.0], abs=12.0)


def test_a_run_agrees_with_itself_and_renamed_hosts_differ_in_name_alone():
    plans = [plan(f"p{n}", 20.0 + 7 * n, at=n) for n in range(6)]
    one = run_on(["a", "b"], plans)
    same, renamed = compare(one, run_on(["a", "b"], plans)), compare(one, run_on(["b", "a"], plans))
    assert (same.same_host, same.same_counts) == (1.0, 1.0)
    assert set(same.usage.values()) | set(same.ranked.values()) | set(same.balance.values()) == {0}
    assert renamed.same_host == 0.0
    assert renamed.usage["memory"] > 0.0
    assert renamed.ranked["memory"] == renamed.balance["memory"] == 0.0


@pytest.mark.parametrize("turned", [False, True])
def test_what_only_one_run_placed_counts_as_different(turned):
    plans = [plan(f"p{n}", 20.0 + 7 * n, at=n) for n in range(6)]
    runs = [run_on(["a", "b"], plans), run_on(["a", "b"], plans[:4])]
    agreement = compare(*(reversed(runs) if turned else runs))
    assert agreement.processes == 6
    assert (agreement.same_host, agreement.same_counts) == pytest.approx((4 / 6, 4 / 6))


def run_on(names, plans):
    return simulation([host(name) for name in names], plans, until=20.0).run()
