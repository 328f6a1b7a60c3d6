"""Faults drawn from a seed: the same seed draws the same faults. Pure."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

Target = Literal["master", "host", "process"]
_Choice = TypeVar("_Choice")

MASTER: Final = "master"


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    Attributes:
        target: what is struck.
        weight: relative frequency among all kinds.
        lasts: the fault lasts until it is undone, e.g. until a killed part is restarted.
        amounts: least and most of its amount.
    """

    target: Target
    weight: int
    lasts: bool = True
    amounts: tuple[float, float] = (0.0, 0.0)


KINDS: Final = {
    "master_kill": Kind("master", 8),
    "master_stop": Kind("master", 6),
    "master_cut": Kind("master", 4),
    "master_disk_full": Kind("master", 3),
    "master_clock": Kind("master", 2, amounts=(1.0, 3600.0)),
    "slave_kill": Kind("host", 8),
    "slave_stop": Kind("host", 6),
    "supervisor_kill": Kind("host", 6, lasts=False),
    "supervisor_stop": Kind("host", 4),
    "process_kill": Kind("process", 12, lasts=False),
    "process_stop": Kind("process", 6),
    "host_cut": Kind("host", 8),
    "host_cut_in": Kind("host", 5),
    "host_cut_out": Kind("host", 5),
    "host_loss": Kind("host", 5, amounts=(0.05, 0.4)),
    "host_off": Kind("host", 6),
    "disk_full": Kind("host", 5),
    "host_clock": Kind("host", 3, amounts=(1.0, 3600.0)),
}

#: Number of faults that overlap, with relative frequencies.
_BURSTS: Final = {1: 6, 2: 3, 3: 1}
#: Seconds within which all faults of a burst begin.
_WITHIN: Final = 2.0
#: Seconds that a fault lasts: too short for a host to be lost, or long enough.
_SHORT: Final = (0.2, 2.0)
_LONG: Final = (4.0, 7.0)
_SHORT_SHARE: Final = 0.6
#: In a round: seconds of each job, number of jobs, length of the line, number of migrations.
_JOB: Final = (0.2, 3.0)
_JOBS: Final = (2, 5)
_LINE: Final = (0, 3)
_MOVES: Final = {0: 3, 1: 4, 2: 1}
#: Versions of the application that are applied: "": none; one that does not run is "faulty".
_VERSIONS: Final = {"": 2, "good": 4, "faulty": 1}
#: Seconds from the request of a version to the first fault, at most.
_LEAD: Final = 6.0
#: Share of the rounds in which a service is cancelled and another one submitted.
_RENEWED: Final = 0.3


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        number: from 1 on.
        kind: of `KINDS`.
        target: a host, a process, or `MASTER`.
        at: seconds after the begin of its round.
        lasts: seconds until it is undone; 0: nothing has to be undone.
        amount: fraction of the packets that are lost, or seconds by which the clock is set back.
    """

    number: int
    kind: str
    target: str
    at: float
    lasts: float
    amount: float = 0.0

    def __str__(self) -> str:
        amount = f" ({self.amount:.2f})" if self.amount else ""
        lasts = f" for {self.lasts:.1f} s" if self.lasts else ""
        return f"fault {self.number}: {self.kind} {self.target}{amount}{lasts}"


@dataclass(frozen=True)
class Move:
    """A request to migrate a process to a host, which may be its own host."""

    process: str
    host: str
    at: float


@dataclass(frozen=True)
class Round:
    """The faults and requests between two judgements.

    Attributes:
        faults: that overlap, in order of `at`.
        moves: migrations that are requested during the faults.
        jobs, line: seconds that each job takes, and each of those that wait in line.
        renews: the guest, a service, is cancelled, and another one submitted.
        version: of the application that is applied before: "good", "faulty" or "" for none.
        lead: seconds between that request and the first fault.
    """

    number: int
    faults: tuple[Fault, ...]
    moves: tuple[Move, ...]
    jobs: tuple[float, ...]
    line: tuple[float, ...]
    renews: bool
    version: str = ""
    lead: float = 0.0


def draw(
    seed: int, hosts: Sequence[str], processes: Sequence[str], movable: Sequence[str]
) -> Iterator[Round]:
    """Yield rounds without end.

    Args:
        seed: of the random numbers.
        hosts: that may be struck.
        processes: that may be struck.
        movable: processes that may be migrated.
    """
    chance = random.Random(seed)  # noqa: S311 - repeatable on purpose
    drawn, number = 0, 0
    while True:
        number += 1
        faults = _burst(chance, drawn, hosts, processes)
        drawn += len(faults)
        count = _weighted(chance, _MOVES)
        moves = tuple(
            Move(chance.choice(movable), chance.choice(hosts), chance.uniform(0.0, _WITHIN))
            for _ in range(count)
        )
        jobs, line = _seconds(chance, _JOBS), _seconds(chance, _LINE)
        renews, version = chance.random() < _RENEWED, _weighted(chance, _VERSIONS)
        lead = chance.uniform(0.0, _LEAD) if version else 0.0
        yield Round(number, faults, moves, jobs, line, renews, version, lead)


def _burst(
    chance: random.Random, drawn: int, hosts: Sequence[str], processes: Sequence[str]
) -> tuple[Fault, ...]:
    """Draw the faults of a burst, each on a target of its own."""
    faults: list[Fault] = []
    size = _weighted(chance, _BURSTS)
    while len(faults) < size:
        name = _weighted(chance, {name: kind.weight for name, kind in KINDS.items()})
        kind = KINDS[name]
        choices = {"master": [MASTER], "host": hosts, "process": processes}[kind.target]
        target = chance.choice(choices)
        at = chance.uniform(0.0, _WITHIN) if size > 1 else 0.0
        span = _SHORT if chance.random() < _SHORT_SHARE else _LONG
        lasts = chance.uniform(*span) if kind.lasts else 0.0
        amount = chance.uniform(*kind.amounts)
        if all(target != other.target for other in faults):
            faults.append(Fault(0, name, target, round(at, 2), round(lasts, 2), round(amount, 2)))
    faults.sort(key=lambda fault: fault.at)
    return tuple(
        Fault(drawn + place, one.kind, one.target, one.at, one.lasts, one.amount)
        for place, one in enumerate(faults, 1)
    )


def _weighted(chance: random.Random, weights: Mapping[_Choice, int]) -> _Choice:
    return chance.choices(list(weights), list(weights.values()))[0]


def _seconds(chance: random.Random, count: tuple[int, int]) -> tuple[float, ...]:
    return tuple(round(chance.uniform(*_JOB), 2) for _ in range(chance.randint(*count)))
