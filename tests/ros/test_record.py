"""Recordings of a real run: equal decisions in a replay, similar ones in a simulation."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.config.settings import MigrationSettings, ProcessDefaults, RecordSettings
from rosrm.errors import RecordError
from rosrm.extensions.registry import Registry
from rosrm.model.values import MigrationPolicy
from rosrm_simulate.runs import SimulationRequest, carry_out, load_record, replay_record
from tests.ros.clusters import MIB, PATIENCE, STEADY, host, job, python, service

HOLD = """
import mmap, sys, time
held = mmap.mmap(-1, int(sys.argv[1]))
for at in range(0, len(held), 4096): held[at] = 1
print("held", flush=True)
time.sleep(1000)
"""
SIZES = (8, 24, 40, 52, 66, 80, 12, 30, 72, 48, 20, 60)


def holder(name: str, mib: int):
    spec = python(name, HOLD, needs={"memory": (mib + 9.0) * MIB, "cpu": 0.0})
    return replace(spec, arguments=(str(mib * MIB),), migration=MigrationPolicy("relaunch"))


@pytest.fixture(scope="module")
def records(make_shared, tmp_path_factory) -> list[Path]:
    """Return the recordings of three runs of one master: stopped, killed, still running.

    In the first run, three hosts are filled up to their limit with processes of 8 to 80 MiB, as in
    Fig. 6 of the paper. There is also a job, a migration and a cancellation. Each later run begins
    with the running processes.
    """
    directory = tmp_path_factory.mktemp("records")
    cluster = make_shared(
        *(host(f"h{n}", memory=240 * MIB) for n in range(3)),
        record=RecordSettings(directory), defaults=ProcessDefaults(needs={"memory": MIB}),
        migration=MigrationSettings(automatic=False), liveness=STEADY,
    )  # fmt: skip
    cluster.run(job("first", "true"))
    cluster.submit(replace(service("wanders"), migration=MigrationPolicy("relaunch")))
    source = cluster.wait("wanders", "running").host
    _fill(cluster)
    cluster.client.migrate("wanders", next(f"h{n}" for n in range(3) if f"h{n}" != source))
    cluster.wait_for_event("migrated", process="wanders")
    cluster.cancel("hold00")
    for number in (signal.SIGINT, signal.SIGKILL):
        cluster.master.end(number)
        cluster.master.process.wait(PATIENCE)
        cluster.reconnect()
        cluster.start_master()
        cluster.wait_for_hosts()
        cluster.run(job(f"after_{number}", "true"))
    return sorted(directory.glob("*.rosrec"))


def _fill(cluster) -> None:
    """Submit holders until no host has room, each after the usage of the former is known.

    The run therefore takes some seconds of known usage.
    """
    for number, mib in enumerate(SIZES):
        name = f"hold{number:02}"
        cluster.submit(holder(name, mib))
        if cluster.wait(name, "running", "queued").state == "queued":
            cluster.cancel(name)  # processes behind it would wait as long as it
            return

        def shows(view, name=name, least=mib * MIB) -> bool:
            return any(row.name == name and row.memory >= least for row in view.processes)

        cluster.wait_until(f"{name} holding {mib} MiB", shows)
    raise AssertionError("the hosts were not full in the end")


def test_it_was_recorded_in_a_file_for_each_run(records):
    assert [path.name for path in records] == [f"rosrm-000{n}.rosrec" for n in (1, 2, 3)]


def test_told_again_the_core_decides_the_same(records):
    replayed, _ = replay_record(load_record(records[0]), Registry.discover())
    assert replayed.decisions > len(SIZES) / 2
    assert replayed.differences == ()
    assert replayed.outcome.migrations == 1
    assert replayed.outcome.finished >= 1


def test_also_a_master_that_took_over_what_ran(records):
    """The recording of a killed master has its initial state, taken from the journal."""
    with pytest.raises(RecordError, match="cut short at byte"):
        load_record(records[1])
    recording = load_record(records[1], cut=True)
    assert recording.header.epoch == 2
    assert len(recording.header.intents["process"]) > 3
    replayed, _ = replay_record(recording, Registry.discover())
    assert replayed.decisions > 0
    assert replayed.differences == ()
    running = [one for one in recording.header.intents["process"].values() if one["owner"]]
    assert {one["spec"]["name"] for one in running} <= set(replayed.outcome.placements)


def test_one_that_still_grows_is_not_taken_for_a_whole_one(records):
    with pytest.raises(RecordError, match="cut short"):
        load_record(records[2])


def test_the_simulation_of_the_run_agrees_with_it(records):
    """The bounds are for a busy machine: observed deviations are several times smaller."""
    report = carry_out(SimulationRequest(records[0]))
    recorded, simulated = report.runs
    agreement = report.agreement
    placed = [len(run.outcome.placements) for run in (recorded, simulated)]
    assert abs(placed[0] - placed[1]) <= 1  # by chance the last one fits or not
    assert agreement.processes == max(placed)
    assert agreement.same_counts >= 0.7
    assert agreement.ranked["memory"] < 0.10
    assert agreement.balance["memory"] < 0.15
    assert agreement.migrations[0] == 1
