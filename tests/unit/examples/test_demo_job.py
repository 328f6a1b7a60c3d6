"""Processes of the demo, and their start times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rosrm_examples import demo_job
from rosrm_examples.demo_job import Scenario, arrivals, budget_for, holder_sizes

SCENARIO = Scenario("street", scans=100, pieces=9, seed=6, pace=1.0, budget=demo_job.BUDGET)


def all_specs(scenario=SCENARIO):
    coming = arrivals(scenario, Path("/out/pieces"), Path("/here"))
    return [spec for arrival in coming for spec in arrival.specs]


def value_after(spec, option):
    return spec.arguments[spec.arguments.index(option) + 1]


def test_the_holders_are_of_the_papers_sizes_and_the_seed_decides():
    sizes = holder_sizes(SCENARIO)
    assert 8 <= min(sizes) <= max(sizes) <= 80
    assert sizes == holder_sizes(SCENARIO)
    assert sizes != holder_sizes(replace(SCENARIO, seed=7))


@pytest.mark.parametrize("budget", [demo_job.LEAST_BUDGET, demo_job.BUDGET])
@pytest.mark.parametrize("seed", range(20))
def test_the_holders_want_more_than_the_hosts_have(seed, budget):
    scenario = replace(SCENARIO, seed=seed, budget=budget)
    holders = [spec for spec in all_specs(scenario) if spec.name.startswith("holder")]
    wanted = sum(spec.needs["memory"] for spec in holders)
    room = 3 * demo_job.MEMORY_LIMIT * budget
    assert 1.2 * room < wanted < 1.4 * room


def test_the_pieces_come_first_and_everything_in_order_of_time():
    coming = arrivals(SCENARIO, Path("/out/pieces"), Path("/here"))
    assert [spec.name for spec in coming[0].specs] == [f"piece_{k:02d}" for k in range(1, 10)]
    assert [arrival.application for arrival in coming[:2]] == ["map", ""]
    assert {spec.application for spec in coming[0].specs} == {"map"}
    times = [arrival.at for arrival in coming]
    assert times[0] == 0.0
    assert times == sorted(times)


@pytest.fixture
def by_kind():
    """Return one spec of each kind of process, whose names are unique."""
    specs = all_specs()
    assert len({spec.name for spec in specs}) == len(specs)
    return {demo_job.kind_of(spec.name): spec for spec in specs}


def test_pieces_are_ros_nodes_that_stay_and_holders_may_move(by_kind):
    piece, holder, recorder = (by_kind[kind] for kind in ("piece", "holder", "recorder"))
    assert piece.ros
    assert piece.environment["OMP_NUM_THREADS"] == "1"
    assert piece.migration.strategy is None
    assert not holder.ros
    assert holder.migration.strategy == "relaunch"
    assert holder.needs["memory"] > float(value_after(holder, "--mb")) * 1e6
    assert recorder.migration.strategy is None


def test_only_one_host_may_take_the_recorder(by_kind):
    required = by_kind["recorder"].required_labels.items()
    hosts = demo_job.host_configs(SCENARIO.budget, cores=2)
    assert [host.host for host in hosts if required <= host.labels.items()] == ["host1"]


def test_the_recorder_alone_reaches_the_limit_of_its_host_and_not_much_more(by_kind):
    recorder = by_kind["recorder"]
    held = float(value_after(recorder, "--grow")) * float(value_after(recorder, "--seconds"))
    assert 0.75 * SCENARIO.budget < held * 1e6 < SCENARIO.budget


def test_a_pace_of_two_is_over_in_half_the_time():
    slow = arrivals(SCENARIO, Path("/out"), Path("/here"))
    fast = arrivals(replace(SCENARIO, pace=2.0), Path("/out"), Path("/here"))
    assert fast[-1].at == pytest.approx(slow[-1].at / 2)
    assert demo_job.cluster_config(2.0).migration.hysteresis == pytest.approx(0.5)


def test_three_slices_with_the_same_limit():
    hosts = demo_job.host_configs(SCENARIO.budget, cores=2)
    assert [host.host for host in hosts] == list(demo_job.HOSTS)
    assert {host.scope for host in hosts} == {"slice"}
    assert {host.limits["memory"] for host in hosts} == {0.8}


def test_less_memory_makes_smaller_hosts():
    assert budget_for(64 * 2**30) == demo_job.BUDGET
    assert budget_for(2 * 2**30) == 512 * 2**20
