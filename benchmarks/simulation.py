"""Speed of `rosrm simulate`, and the cost of a recording for the master.

- `events_per_s`: events that the simulated master processes in a second of real time, for a
  thousand jobs on fifty hosts in ten minutes; `seconds` for all of it.
- `note_us`: CPU time of the master's loop for one event that is recorded. `written_us`: CPU time of
  the thread that encodes and writes, for a batch of readings of `hosts_in_a_batch` hosts.
  `bytes_per_reading`: size of one reading in the file.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.machine import parser, print_report, say
from benchmarks.stopping import run
from rosrm.core.master.events import ReadingsReceived
from rosrm.core.master.settings import CoreSettings
from rosrm.extensions.placement import PlacementPlugins, ScoringLink
from rosrm.master.recorder import Recorder
from rosrm.model.values import RESOURCE_SLOTS, Kind, ProcessSpec, ResourceDescription
from rosrm.recording.reader import Header
from rosrm_scoring.weighted import Weighted, WeightedOptions
from rosrm_simulate.engine import Simulation
from rosrm_simulate.workload import Curve, ProcessPlan, SimulatedHost, Workload

_JOBS = 1_000
_HOSTS = 50
_SPAN = 600.0
_BATCHES = 2_000
_IN_A_BATCH = 100
_RESOURCES = 3


def fleet(seed: int) -> Workload:
    """Return a thousand random jobs on fifty equal hosts."""
    random = np.random.default_rng(seed)
    resources = (
        ResourceDescription("memory", "B", 8.0 * 2**30),
        ResourceDescription("cpu", "core", 4.0),
    )
    hosts = [SimulatedHost(f"h{n}", resources, {"memory": 0.8, "cpu": 0.9}) for n in range(_HOSTS)]
    plans = []
    for number in range(_JOBS):
        memory, cpu = random.uniform(1e8, 2e9), random.uniform(0.2, 2.0)
        spec = ProcessSpec(
            f"j{number}", command=("job",), kind=Kind.JOB, needs={"memory": memory, "cpu": cpu}
        )
        plans.append(
            ProcessPlan(
                spec, random.uniform(0.0, _SPAN), Curve((0.0,), (memory,)), cpu,
                duration=random.uniform(10.0, 100.0),
            )
        )  # fmt: skip
    return Workload("fleet", tuple(hosts), tuple(plans))


def simulated(seed: int) -> tuple[float, int]:
    """Return the seconds of CPU and the events of one run."""
    placement = PlacementPlugins((ScoringLink("weighted", Weighted(WeightedOptions())),))
    simulation = Simulation(fleet(seed), CoreSettings(), placement, {})
    began = time.process_time()
    outcome = simulation.run()
    took = time.process_time() - began
    assert outcome.finished == _JOBS
    return took, outcome.events


def recorded() -> tuple[float, float, float]:
    """Return microseconds in the loop and in the thread for a batch, and bytes for a reading."""
    random = np.random.default_rng(1)
    ids = np.arange(1, _IN_A_BATCH + 1)
    usage = np.zeros((_IN_A_BATCH, RESOURCE_SLOTS))
    limit = np.ones((_IN_A_BATCH, RESOURCE_SLOTS))
    usage[:, :_RESOURCES] = random.uniform(0.0, 1.0, (_IN_A_BATCH, _RESOURCES))
    limit[:, :_RESOURCES] = 0.8
    numbers = ids.astype(np.uint64)
    batch = ReadingsReceived(
        ids, numbers, numbers, numbers, np.ones(_IN_A_BATCH, np.bool_),
        np.zeros(_IN_A_BATCH, np.uint32), usage, limit,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as directory:
        header = Header("0", "bench", {}, 1, 0.0, {})
        recorder = Recorder(Path(directory), header, 10**9, 1)
        in_all, in_loop = time.process_time(), time.thread_time()
        for number in range(_BATCHES):
            recorder.note(batch, float(number), 0.0, ())
        in_loop = time.thread_time() - in_loop
        recorder.close("done")
        in_all = time.process_time() - in_all
        size = recorder.path.stat().st_size
    us = 1e6 / _BATCHES
    return in_loop * us, (in_all - in_loop) * us, size / _BATCHES / _IN_A_BATCH


def main() -> None:
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=3, help="number of simulated workloads")
    runs = command_line.parse_args().runs
    made = [simulated(seed) for seed in range(runs)]
    seconds, events = median(took for took, _ in made), median(float(count) for _, count in made)
    say(f"{events:.0f} events in {seconds:.1f} s of CPU, {events / seconds:.0f} a second")
    costs = [recorded() for _ in range(runs)]
    note, written, size = (median(cost[at] for cost in costs) for at in range(3))
    say(f"recording {_IN_A_BATCH} readings: {note:.2f} us in the loop, {written:.1f} us beside it")
    figures = {
        "events_per_s": round(events / seconds), "events": round(events),
        "seconds": round(seconds, 2), "note_us": round(note, 2), "written_us": round(written, 1),
        "hosts_in_a_batch": _IN_A_BATCH, "bytes_per_reading": round(size, 1),
    }  # fmt: skip
    print_report("simulation", figures, runs=runs)


if __name__ == "__main__":
    sys.exit(run("simulation", main))
