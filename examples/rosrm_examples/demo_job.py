"""Plan of the demo: the mapping job, the processes that hold memory, a recorder, and their times.

Pure: everything is computed from a seed.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import Kind, MigrationPolicy, ProcessSpec, StopPolicy
from rosrm.config.settings import (
    ClusterConfig,
    HostConfig,
    MigrationSettings,
    ScoringChoice,
)

HOSTS: Final = ("host1", "host2", "host3")
#: The application of the processes that map the drive.
APPLICATION: Final = "map"
MEMORY_LIMIT: Final = 0.8
#: Stop of a ROS node. On a busy machine its end may take more than the usual 10 s, and a node that
#: is killed leaves its shared memory. `LocalCluster` waits 60 s for a slave and its processes.
NODE_STOP: Final = StopPolicy(interrupt_grace=15.0, terminate_grace=5.0)
#: Bytes of memory in the budget of each host, where the machine has as much.
BUDGET: Final = 768 * 2**20
#: Bytes; with less than this a host has no room for the demo.
LEAST_BUDGET: Final = 448 * 2**20

#: Part of the free memory that one host may take.
_SHARE: Final = 0.25
#: MB of a holder, from the paper's Fig. 6.
_LEAST_MB, _MOST_MB = 8, 80
#: MB of a holder's own footprint, because it is a Python process.
_FOOTPRINT_MB = 13
_PIECE_MB = 95
#: Memory of all holders over that of all hosts, so that the queue has to wait.
_TOO_MUCH: Final = 1.25

#: Seconds at the pace 1.
_PIECE_S: Final = 4.5
_ARRIVAL_S: Final = 0.42
_HOLD_S: Final = 24.0
#: Time at which the first holders have ended and those in the queue have been placed.
_RECORDER_AT_S: Final = 34.0
_RECORD_S: Final = 15.0
_RECORDER_MB: Final = 20
#: Part of its host's memory that the recorder takes in each second.
_RECORDER_GROWTH: Final = 0.055

#: Label of the host with the disk that the recorder needs, so that it cannot be migrated.
_DISK_LABEL: Final = {"disk": "fast"}


@dataclass(frozen=True)
class Scenario:
    """The settings of one demo.

    Attributes:
        drive: name or path of the drive to map.
        scans: number of scans of the drive.
        pieces: number of pieces of the drive.
        seed: of the holders' sizes.
        pace: how many times as fast as usual all processes arrive and end.
        budget: bytes of each host.
    """

    drive: str
    scans: int
    pieces: int
    seed: int
    pace: float
    budget: int


@dataclass(frozen=True)
class Arrival:
    """Processes that are requested together.

    Attributes:
        at: seconds after the beginning.
        application: of which these are all processes; "": they are single processes.
    """

    at: float
    specs: tuple[ProcessSpec, ...]
    application: str = ""


def budget_for(available: float) -> int:
    """Return the memory of each host, bytes, for so much free memory on this machine."""
    return int(min(BUDGET, available * _SHARE))


def cluster_config(pace: float) -> ClusterConfig:
    """Return the master's settings: Eq. 1 over memory, and prompt but few migrations."""
    return ClusterConfig(
        name="demo",
        scoring=(ScoringChoice(options={"weights": {"memory": 1.0, "cpu": 0.1}}),),
        migration=MigrationSettings(
            hysteresis=1.0 / pace, cooldown=5.0 / pace, headroom=0.02, max_in_flight=1
        ),
    )


def host_configs(budget: int, cores: int) -> list[HostConfig]:
    """Return three hosts on one machine: each measures its own processes against a budget.

    Only memory is limited: each host may use all cores, and its disk is large.
    """
    return [
        HostConfig(
            host=name,
            labels=_DISK_LABEL if name == HOSTS[0] else {},
            scope="slice",
            budget={"memory": budget, "cpu": cores, "disk": 2**30},
            limits={"memory": MEMORY_LIMIT, "cpu": 1.0},
        )
        for name in HOSTS
    ]


def arrivals(scenario: Scenario, out: Path, working_directory: Path) -> list[Arrival]:
    """Return the application that maps the drive and all submissions, in order of time.

    Args:
        out: folder for the mapped pieces, absolute.
        working_directory: in which the drive is found.
    """
    pieces = tuple(
        _piece(scenario, number, out, working_directory) for number in range(1, scenario.pieces + 1)
    )
    coming = [Arrival(0.0, pieces, APPLICATION)]
    every = _ARRIVAL_S / scenario.pace
    for number, mb in enumerate(holder_sizes(scenario), start=1):
        coming.append(Arrival(number * every, (_holder(scenario, number, mb),)))
    coming.append(Arrival(_RECORDER_AT_S / scenario.pace, (_recorder(scenario),)))
    return sorted(coming, key=lambda arrival: arrival.at)


def holder_sizes(scenario: Scenario) -> list[int]:
    """Return the MB of each holder, in sum more than the hosts can hold."""
    room_mb = len(HOSTS) * MEMORY_LIMIT * scenario.budget / 1e6
    chance = random.Random(scenario.seed)  # noqa: S311 - sizes, no secrets
    sizes: list[int] = []
    while sum(sizes) + len(sizes) * _FOOTPRINT_MB < _TOO_MUCH * room_mb:
        sizes.append(chance.randint(_LEAST_MB, _MOST_MB))
    return sizes


def kind_of(name: str) -> str:
    """Return the kind of a process of the demo: "piece", "holder" or "recorder"."""
    return name.partition("_")[0]


def count_by_kind(names: Sequence[str]) -> dict[str, int]:
    """Return the number of processes of each kind."""
    kinds = [kind_of(name) for name in names]
    return {kind: kinds.count(kind) for kind in ("piece", "holder", "recorder")}


def _piece(scenario: Scenario, number: int, out: Path, working_directory: Path) -> ProcessSpec:
    """Return the process that maps a piece, slowed down to some seconds, to be visible."""
    rate = math.ceil(scenario.scans / scenario.pieces) / _PIECE_S * scenario.pace
    return ProcessSpec(
        name=f"piece_{number:02d}",
        module="rosrm_examples.map_piece",
        arguments=(
            "--drive", scenario.drive, "--piece", str(number), "--of", str(scenario.pieces),
            "--out", str(out), "--rate", f"{rate:.2f}",
        ),
        environment={"OMP_NUM_THREADS": "1"},
        working_directory=str(working_directory),
        ros=True,
        kind=Kind.JOB,
        needs={"memory": _PIECE_MB * 1e6},
        stop=NODE_STOP,
        application=APPLICATION,
    )  # fmt: skip


def _holder(scenario: Scenario, number: int, mb: int) -> ProcessSpec:
    return ProcessSpec(
        name=f"holder_{number:02d}",
        module="rosrm_examples.holder",
        arguments=("--mb", str(mb), "--seconds", f"{_HOLD_S / scenario.pace:.1f}"),
        kind=Kind.JOB,
        needs={"memory": (mb + _FOOTPRINT_MB) * 1e6},
        migration=MigrationPolicy(strategy="relaunch"),
    )


def _recorder(scenario: Scenario) -> ProcessSpec:
    """Return the process that grows, and is bound to the host with the fast disk.

    It does not declare its growth, which brings its host to the limit.
    """
    growth_mb = _RECORDER_GROWTH * scenario.budget / 1e6 * scenario.pace
    return ProcessSpec(
        name="recorder",
        module="rosrm_examples.holder",
        arguments=(
            "--mb", str(_RECORDER_MB), "--grow", f"{growth_mb:.1f}",
            "--seconds", f"{_RECORD_S / scenario.pace:.1f}",
        ),
        kind=Kind.JOB,
        needs={"memory": (_RECORDER_MB + _FOOTPRINT_MB) * 1e6},
        required_labels=_DISK_LABEL,
    )  # fmt: skip
