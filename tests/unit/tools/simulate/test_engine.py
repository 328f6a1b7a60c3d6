"""Simulated cluster: the host model, and no lost or doubled process."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.core.master import events as happened
from rosrm.core.master.state.process import ProcessPhase
from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.values import InstanceState
from rosrm_simulate.workload import Curve, SimulatedLink

from .workloads import MIB, host, plan, run, simulation

START, READY, STOP, WIRE = 0.3, 0.7, 0.1, 0.002

# --- the model of a host ----------------------------------------------------------------------


def test_a_job_takes_its_duration_where_it_has_all_the_cpu_it_wants():
    outcome = run([host("a", cpu=2.0)], [plan("p", cpu=1.5, duration=10.0)])
    assert outcome.finished == 1
    assert outcome.makespan == pytest.approx(START + 2 * WIRE + 10.0, abs=0.01)


def test_on_a_crowded_host_jobs_take_longer_in_proportion():
    """Two that want 2 cores each on 2 cores get one each; the longer one then runs alone."""
    plans = [plan("long", cpu=2.0, duration=10.0, needs={"memory": MIB, "cpu": 0.0}),
             plan("short", cpu=2.0, duration=4.0, needs={"memory": MIB, "cpu": 0.0})]  # fmt: skip
    outcome = run([host("a", cpu=2.0)], plans)
    assert outcome.ends["short"] == pytest.approx(START + 8.0, abs=0.05)
    assert outcome.ends["long"] == pytest.approx(START + 14.0, abs=0.05)


def test_others_on_the_host_take_their_part_of_the_cpu():
    job = plan("p", cpu=2.0, duration=5.0, needs={"memory": MIB, "cpu": 0.0})
    outcome = run([host("a", cpu=2.0, busy={"cpu": 0.5})], [job])
    assert outcome.makespan == pytest.approx(START + 10.0, abs=0.05)


def test_a_job_that_wants_no_cpu_is_not_slowed():
    plans = [plan("sleeps", duration=5.0), plan("burns", cpu=8.0, duration=9.0, needs={})]
    assert run([host("a")], plans).ends["sleeps"] == pytest.approx(START + 5.0, abs=0.01)


def test_what_the_master_reads_is_what_the_processes_hold():
    """Usage is 50 MiB and 150 MiB on 1000 MiB, and 10 % by others."""
    outcome = run(
        [host("a", 1000.0, busy={"memory": 0.1})], [plan("p"), plan("q", 150.0)], until=5.0
    )
    assert outcome.curves.usage["memory"][-1, 0] == pytest.approx(0.3)


def test_memory_grows_with_age_up_to_its_bound():
    outcome = run([host("a", 1000.0)], [plan("p", 100.0, growth=50.0, most=300.0)], until=20.0)
    curve, times = outcome.curves.usage["memory"][:, 0], outcome.curves.times
    after = times > START + 0.01
    wanted = np.minimum(0.1 + 0.05 * (times - START - WIRE), 0.3)
    assert np.abs(curve - wanted)[after].max() < 0.006  # a reading is up to a period old
    assert curve[-1] == pytest.approx(0.3)


@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(0, 1e9)), min_size=1, max_size=6))
def test_a_curve_goes_through_its_points_and_never_beyond(pieces):
    ages = tuple(np.concatenate(([0.0], np.cumsum([age for age, _ in pieces]))))
    amounts = (0.0, *(amount for _, amount in pieces))
    curve = Curve(ages, amounts)
    assert [curve.at(age) for age in ages] == pytest.approx(list(amounts))
    tried = [curve.at(age) for age in np.linspace(0.0, ages[-1] + 1.0, 50)]
    assert min(tried) >= 0.0 and max(tried) <= curve.most * (1 + 1e-9)  # noqa: PT018


# --- decisions of the cores -------------------------------------------------------------------


def test_equal_processes_are_spread_evenly_and_none_goes_over_the_limit():
    """With 100 MiB each, 8 fit below 80 % of 1000 MiB: of 30 the hosts take 24."""
    hosts = [host(name, 1000.0) for name in "abc"]
    outcome = run(hosts, [plan(f"p{n:02}", 100.0, at=0.5 * n) for n in range(30)])
    assert len(outcome.placements) == 24
    first = [where[0] for where in outcome.placements.values()]
    assert {first.count(name) for name in "abc"} == {8}
    assert (outcome.running, outcome.waiting) == (24, 6)
    assert np.nanmax(outcome.curves.usage["memory"]) <= 0.8
    assert len(outcome.never_placed) == 6
    assert "no host can take it now" in outcome.never_placed["p24"]
    assert "waits behind p24" in outcome.never_placed["p29"]


def test_on_more_hosts_more_is_placed_and_the_makespan_is_shorter():
    plans = [plan(f"p{n:02}", 300.0, cpu=1.0, duration=10.0) for n in range(12)]
    few, many = (run([host(f"h{n}") for n in range(count)], plans) for count in (2, 6))
    assert few.finished == many.finished == 12
    assert many.makespan < 0.5 * few.makespan
    assert many.wait_max == 0.0 < few.wait_max


def test_a_host_over_its_limit_gives_a_process_away():
    """Fig. 10: growth brings a host over its limit, and a process moves."""
    plans = [
        plan("grows", 100.0, growth=40.0, most=700.0),
        plan("quiet", 200.0, strategy="relaunch"),
    ]
    hosts = [host("a", 1000.0, labels={"x": "1"}), host("b", 1000.0, joins=2.0)]
    moves, stays = (run(hosts, plans, until=60.0, automatic=automatic) for automatic in (1, 0))
    assert moves.placements["quiet"] == ("a", "b")
    assert (moves.migrations, stays.migrations) == (1, 0)
    assert 0.0 < moves.over_limit < 5.0
    assert stays.over_limit == pytest.approx(60.0 - 12.8, abs=0.3)  # from 600 of 700 MiB on


@pytest.mark.parametrize(
    ("strategy", "ros", "total"), [("relaunch", False, 18), ("handoff", True, 10)]
)
def test_a_relaunched_job_begins_anew_and_one_that_hands_over_goes_on(strategy, ros, total):
    """The job moves after 8 of its 10 seconds."""
    moved = (8.0 + START, happened.MigrationRequested(0, "p"))
    plans = [plan("p", duration=10.0, strategy=strategy, ros=ros)]
    outcome = run([host("a"), host("b")], plans, requests=[moved])
    assert outcome.placements["p"] == ("a", "b")
    assert outcome.finished == 1
    assert outcome.makespan == pytest.approx(total + START, abs=0.7)


def test_a_restarted_node_is_ready_when_it_is_seen_in_the_graph_again():
    """The node is seen 0.7 s after each start, also after a restart at 5 s."""
    restart = (5.0, happened.RestartRequested(0, ("p",)))
    made = simulation([host("a")], [plan("p", ros=True)], requests=[restart], until=10.0)
    take, ready = made.meter.take, []

    def watch(state, event, commands, now):
        statuses = getattr(event, "statuses", ())
        ready.extend(now for one in statuses if one.state is InstanceState.READY)
        take(state, event, commands, now)

    made.meter.take = watch
    made.run()
    assert ready == pytest.approx([START + READY, 5.0 + STOP + START + READY], abs=0.05)


def test_what_a_leaving_slave_ends_goes_elsewhere():
    hosts = [host("a", leaves=5.0), host("b", joins=1.0)]
    outcome = run(hosts, [plan("p", duration=10.0)])
    assert outcome.placements["p"] == ("a", "b")
    assert outcome.finished == 1


def test_of_a_lost_host_the_processes_are_not_forgotten():
    """They have no successors, stay in memory and are unreachable."""
    made = simulation([host("a", leaves=5.0, lost=True), host("b", joins=1.0)], [plan("p")])
    outcome = made.run()
    assert made.state.processes["p"].phase is ProcessPhase.UNREACHABLE
    assert (outcome.running, outcome.finished, outcome.processes) == (1, 0, 1)


def test_a_process_that_no_host_may_take_is_named_with_the_reason():
    outcome = run([host("a")], [plan("p", required_labels={"gpu": "yes"})], until=5.0)
    assert "gpu" in outcome.never_placed["p"]


def test_processes_share_the_devices_of_a_host():
    """The second job waits for the GPU of the first one."""
    gpu = Device("gpu", "0")
    plans = [plan(name, duration=5.0, devices=(DeviceNeed("gpu"),)) for name in ("p", "q")]
    outcome = run([host("a", devices=(gpu,)), host("b")], plans)
    assert outcome.finished == 2
    assert outcome.ends["q"] >= outcome.ends["p"] + 5.0


def test_a_cancelled_process_is_neither_finished_nor_waiting():
    cancel = (3.0, happened.CancelRequested(0, ("p",)))
    outcome = run([host("a")], [plan("p"), plan("q", duration=2.0)], requests=[cancel])
    assert (outcome.finished, outcome.ended_otherwise, outcome.running) == (1, 1, 0)
    assert outcome.ends["p"] == pytest.approx(3.0 + STOP, abs=0.05)


def test_a_long_quiet_time_costs_nothing():
    """A day of one job is fast, because readings without a change are left out."""
    outcome = run([host("a")], [plan("p", duration=86_400.0)])
    assert outcome.makespan == pytest.approx(86_400.0, abs=1.0)
    assert outcome.events < 5_000


def test_the_gap_is_measured_over_time():
    """One process of 40 % on one of two hosts, from 10 s to the end at 20 s: half of 40 %."""
    outcome = run([host("a", 1000.0), host("b", 1000.0)],
                  [plan("x", 0.0, duration=1.0), plan("p", 400.0, at=10.0 - START)],
                  until=20.0)  # fmt: skip
    assert outcome.span == pytest.approx(20.0)
    assert outcome.imbalance["memory"] == pytest.approx(0.2, abs=0.005)


# --- invariants of any simulation -------------------------------------------------------------

PLANS = st.lists(
    st.builds(
        dict, memory=st.floats(1, 900), at=st.floats(0, 30), cpu=st.floats(0, 6),
        duration=st.one_of(st.just(inf), st.floats(0.01, 40)),
        growth=st.sampled_from([0.0, 0.0, 30.0]), most=st.floats(900, 1200),
        strategy=st.sampled_from([None, "relaunch", "handoff"]), ros=st.booleans(),
    ),
    min_size=1, max_size=15,
)  # fmt: skip
HOSTS = st.lists(
    st.builds(
        dict, memory=st.floats(200, 2000), cpu=st.floats(0.5, 8), joins=st.floats(0, 20),
        leaves=st.one_of(st.just(inf), st.floats(21, 40)), lost=st.booleans(),
        max_processes=st.integers(0, 4),
    ),
    min_size=1, max_size=5,
)  # fmt: skip


def built(hosts, plans):
    return (
        [host(f"h{n}", **fields) for n, fields in enumerate(hosts)],
        [plan(f"p{n}", **_fit(fields)) for n, fields in enumerate(plans)],
    )


def _fit(fields):
    """Make a process with `handoff` a ROS node, because only ROS nodes hand over."""
    return {**fields, "ros": fields["ros"] or fields["strategy"] == "handoff"}


@settings(max_examples=25)
@given(hosts=HOSTS, plans=PLANS)
def test_every_process_is_somewhere_exactly_once(hosts, plans):
    """In the master's state a process is finished, ended otherwise, running or waiting.

    In truth no process has two owners, and no ended one runs. Processes that never got a host are
    named.
    """
    made = simulation(*built(hosts, plans), until=80.0)
    ended: list[str] = []
    take = made.meter.take

    def watch(state, event, commands, now):
        ended.extend(one.process for one in commands if getattr(one, "kind", "") == "finished")
        take(state, event, commands, now)

    made.meter.take = watch
    outcome = made.run()

    assert outcome.processes == len(plans)
    assert outcome.processes == (
        outcome.finished + outcome.ended_otherwise + outcome.running + outcome.waiting
    )
    assert len(set(ended)) == len(ended) == outcome.finished
    running = [one.process for machine in made.machines.values() for one in machine.programs]
    assert not set(running) & set(ended)
    moving = set(made.state.migrations)
    assert all(running.count(name) == 1 for name in set(running) - moving)
    assert set(outcome.never_placed) == {
        name for name in made.state.processes if name not in outcome.placements
    }
    up = outcome.curves.usage["memory"]
    assert np.all((up >= 0.0) | np.isnan(up))


@settings(max_examples=5)
@given(hosts=HOSTS, plans=PLANS)
def test_the_same_workload_gives_the_same_run(hosts, plans):
    one, other = (run(*built(hosts, plans), until=60.0) for _ in range(2))
    assert one.placements == other.placements
    assert one.ends == other.ends
    for field in ("events", "over_limit", "imbalance"):
        assert getattr(one, field) == getattr(other, field)


def test_fewer_and_more_hosts_than_the_workload_has():
    made = simulation([host("a"), host("b")], [plan("p")]).workload
    assert [one.name for one in made.with_hosts(1).hosts] == ["a"]
    assert [one.name for one in made.with_hosts(5).hosts] == ["a", "b", "a.1", "b.1", "a.2"]


def test_progress_is_told():
    told = []
    plans = [plan(f"p{n}", 5.0, at=0.5 * n, duration=5.0) for n in range(400)]
    simulation([host("a", 8000.0)], plans).run(told.append)
    assert [one.events for one in told] == sorted(one.events for one in told)
    assert told[-1].ended <= 400 == told[-1].processes


def test_flows_stay_within_the_limits_of_simulated_links():
    """The detector runs behind the fast link, although the host of the slow one is emptier."""
    hosts = [
        host("robot", 100.0, link=SimulatedLink(100e6, 0.01)),
        host("slow", 4096.0, link=SimulatedLink(5e6, 0.03)),
        host("fast", link=SimulatedLink(100e6, 0.01)),
    ]
    robot = {"needs": {"memory": 70 * MIB}, "required_labels": {"name": "robot"}}
    hosts[0] = replace(hosts[0], labels={"name": "robot"})
    plans = [plan("camera", **robot), plan("detector", at=1.0, talks_to={"camera": 20e6})]
    simulated = simulation(hosts, plans, until=5.0)
    simulated.run()
    processes = simulated.state.processes
    assert simulated.state.instances[processes["detector"].owner].host.name == "fast"
    links = simulated.state.hosts.links
    assert links.round_trip[0, 1] == links.round_trip[1, 0] == pytest.approx(0.04)


# --- moves for more than limits -----------------------------------------------------------------


def test_a_process_of_a_lower_priority_makes_room_on_virtual_time():
    """Settings of the preemption can be tried without a cluster."""
    hosts = [host("a", 1000.0), host("b", 400.0)]
    plans = [
        plan("low", 300.0, strategy="relaunch"),
        plan("high", 700.0, at=10.0, duration=5.0, priority=5),
    ]
    assert run(hosts, plans, until=60.0).finished == 1
    assert run(hosts, plans, until=60.0, preemption=False).finished == 0


def test_the_load_is_evened_out_on_virtual_time():
    """Here the one host gets all processes before the other one is there."""
    plans = [plan(f"p{i}", 150.0, strategy="relaunch") for i in range(4)]
    hosts = [host("a", 1000.0), host("b", 1000.0, joins=20.0)]
    for automatic, used in ((False, 0.6), (True, 0.3)):
        outcome = run(hosts, plans, until=100.0, rebalance=automatic)
        assert outcome.curves.usage["memory"][-1, 0] == pytest.approx(used, abs=0.01)


def test_a_job_is_stopped_after_its_time_limit_on_virtual_time():
    """The job has not finished; nothing else happens for much longer than the other times last."""
    plans = [plan("p", duration=900.0, time_limit=90.0), plan("q", duration=5.0, time_limit=90.0)]
    outcome = run([host("a")], plans)
    assert (outcome.finished, outcome.ended_otherwise) == (1, 1)
    assert outcome.ends["p"] == pytest.approx(90.0, abs=1.0)
