"""Comparisons by one amount: usage of a short or failed run does not lower the needs."""

from __future__ import annotations

import pytest

from tests.unit.core.cluster import GIB, Cluster, Machine, job, movable, process


@pytest.mark.parametrize("need", ["measured", "declared"])
def test_a_process_does_not_move_to_and_fro_at_a_constant_load(need: str) -> None:
    """Both hosts are compared by the usage of the process, whichever need chooses one."""
    machines = [Machine(name, memory=10 * GIB) for name in "ab"]
    cluster = Cluster(
        *machines, rebalance=True, rebalance_after=20.0, cooldown=10.0, need=need, settle=5.0
    )
    for machine in machines:
        machine.shown["p"] = {"memory": 5 * GIB, "cpu": 0.1}
    cluster.submit(movable("p"))
    cluster.wait(300.0, tick=0.5)
    assert cluster["p"].migrations <= 1


def test_usage_measured_at_a_move_is_reserved_until_the_readings_show_the_process() -> None:
    """Its declared needs stay reserved, less what it uses."""
    machines = [Machine(name, memory=16 * GIB) for name in "ab"]
    cluster = Cluster(*machines, settle=5.0)
    cluster.submit(movable("p", needs={"memory": GIB}))
    for machine in machines:
        machine.shown["p"] = {"memory": 6 * GIB, "cpu": 1.0}
    cluster.wait(6.0)
    assert cluster.migrate("p").accepted
    for machine in machines:
        machine.shown["p"] = {"memory": 0.25 * GIB, "cpu": 0.1}
    cluster.wait(30.0)
    owner = cluster.state.instances[cluster["p"].owner]
    assert owner.reserved[0] * 16 == pytest.approx(0.75)
    assert owner.reserved[1] == 0.0


@pytest.mark.parametrize(("code", "run_time"), [(1, 600.0), (0, 0.5)])
def test_failed_and_short_runs_never_lower_the_learned_needs(code: int, run_time: float) -> None:
    """Such runs may have ended early; a larger peak of such a run still counts."""
    cluster = Cluster(Machine("a"))

    def run(name: str, memory: float, code: int, run_time: float) -> float:
        spec = job(name, command=("./slam",))
        cluster.machines["a"].shown[name] = {"memory": memory, "cpu": 0.5}
        cluster.submit(spec)
        cluster.wait(0.2)
        cluster.finish(name, code=code, run_time=run_time)
        return cluster.state.estimate(spec).amounts["memory"]

    learned = run("good", 4 * GIB, 0, 600.0)
    for number in range(10):
        assert run(f"bad{number}", 0.1 * GIB, code, run_time) == learned
    assert run("larger", 8 * GIB, code, run_time) > learned


def test_readings_after_a_long_cut_are_as_far_ahead_as_the_time_explains() -> None:
    """The slave has counted its cycles during the cut; a forged sequence is still refused."""
    cluster = Cluster("a", "b").with_processes(process("p"))
    machine = cluster.machines["a"]
    cluster.cut("a", seconds=5.0)
    machine.sequence += 1040
    cluster.reconnect("a", seconds=0.2)
    assert not cluster.recorded("reading_refused")
    machine.sequence += 5000
    cluster.wait(0.2)
    assert cluster.recorded("reading_refused")
