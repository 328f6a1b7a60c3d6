"""What the demo runs, and when: the mapping job, the processes that hold memory, and a recorder.

Nothing here happens: these are plans, made of a seed.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import Kind, MigrationPolicy, ProcessSpec
from rosrm.config.settings import (
    ClusterConfig,
    HostConfig,
    MigrationSettings,
    ScoringChoice,
)

HOSTS: Final = ("host1", "host2", "host3")
MEMORY_LIMIT: Final = 0.8
#: Bytes of memory that each host counts as its own, where the machine has as much.
BUDGET: Final = 768 * 2**20
#: With less than this a host has no room for what the demo shows.
LEAST_BUDGET: Final = 448 * 2**20

#: Part of the free memory that one host may take.
_SHARE: Final = 0.25
#: MB that a holder holds, from the paper's Fig. 6.
_LEAST_MB, _MOST_MB = 8, 80
#: MB that a holder takes beside, for it is a Python process.
_FOOTPRINT_MB = 13
_PIECE_MB = 95
#: The holders want this much more than the hosts have to give: so the queue comes to wait.
_TOO_MUCH: Final = 1.25

#: Seconds at the pace 1.
_PIECE_S: Final = 4.5
_ARRIVAL_S: Final = 0.42
_HOLD_S: Final = 24.0
#: The recorder comes when the first holders have ended, and those that waited have come in.
_RECORDER_AT_S: Final = 34.0
_RECORD_S: Final = 15.0
_RECORDER_MB: Final = 20
#: Part of its host's memory that the recorder takes in each second.
_RECORDER_GROWTH: Final = 0.055

#: The host that has what the recorder needs, and so cannot give it away.
_DISK_LABEL: Final = {"disk": "fast"}


@dataclass(frozen=True)
class Scenario:
    """What one demo is made of.

    Attributes:
        drive: name or path of the drive to map.
        scans: of the drive.
        pieces: that it is cut into.
        seed: of the holders' sizes.
        pace: how many times faster than usual everything comes and goes.
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
    """Processes that are submitted together, `at` seconds after the beginning."""

    at: float
    specs: tuple[ProcessSpec, ...]


def budget_for(available: float) -> int:
    """The memory of each host, bytes, where so much is free on this machine."""
    return int(min(BUDGET, available * _SHARE))


def cluster_config(pace: float) -> ClusterConfig:
    """The master's settings: Eq. 1 over memory, and calm but prompt moves."""
    return ClusterConfig(
        name="demo",
        scoring=ScoringChoice(options={"weights": {"memory": 1.0, "cpu": 0.1}}),
        migration=MigrationSettings(
            hysteresis=1.0 / pace, cooldown=5.0 / pace, headroom=0.02, max_in_flight=1
        ),
    )


def host_configs(budget: int, cores: int) -> list[HostConfig]:
    """Three hosts out of one machine: each counts its own processes against a budget.

    The memory is what the demo is about: each host may use all cores, and its disk is large.
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
    """Everything that is submitted, in order of time.

    Args:
        out: folder for the mapped pieces, absolute.
        working_directory: in which the drive is found.
    """
    pieces = tuple(
        _piece(scenario, number, out, working_directory) for number in range(1, scenario.pieces + 1)
    )
    coming = [Arrival(0.0, pieces)]
    every = _ARRIVAL_S / scenario.pace
    for number, mb in enumerate(holder_sizes(scenario), start=1):
        coming.append(Arrival(number * every, (_holder(scenario, number, mb),)))
    coming.append(Arrival(_RECORDER_AT_S / scenario.pace, (_recorder(scenario),)))
    return sorted(coming, key=lambda arrival: arrival.at)


def holder_sizes(scenario: Scenario) -> list[int]:
    """MB that each holder holds: as many as overfill the hosts."""
    room_mb = len(HOSTS) * MEMORY_LIMIT * scenario.budget / 1e6
    chance = random.Random(scenario.seed)  # noqa: S311 - sizes, no secrets
    sizes: list[int] = []
    while sum(sizes) + len(sizes) * _FOOTPRINT_MB < _TOO_MUCH * room_mb:
        sizes.append(chance.randint(_LEAST_MB, _MOST_MB))
    return sizes


def kind_of(name: str) -> str:
    """What a process of the demo is, by its name: "piece", "holder" or "recorder"."""
    return name.partition("_")[0]


def count_by_kind(names: Sequence[str]) -> dict[str, int]:
    """How many there are of each kind."""
    kinds = [kind_of(name) for name in names]
    return {kind: kinds.count(kind) for kind in ("piece", "holder", "recorder")}


def _piece(scenario: Scenario, number: int, out: Path, working_directory: Path) -> ProcessSpec:
    """Slowed down to some seconds, so that there is something to see."""
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
    """Takes more and more memory, and is bound to the host with the fast disk.

    It says nothing of its growth: that is what brings its host to the limit.
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
