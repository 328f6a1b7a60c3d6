"""Replay of a record in a core, and comparison of its decisions with the recorded ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from rosrm.core.master.commands import Command
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery import journal_gap
from rosrm.core.master.recovery.restore import restore
from rosrm.core.master.reducer import step
from rosrm.core.master.settings import CoreSettings
from rosrm.extensions.contracts import MigrationStrategy
from rosrm.extensions.declared_fields import Declared
from rosrm.extensions.placement import ChainOf, PlacementPlugins
from rosrm.recording.encoding import Happened, decisions
from rosrm.recording.reader import Recording
from rosrm_simulate.meter import Meter, Outcome

#: Number of differences that are shown in full.
_TOLD: Final = 5

Watcher = Callable[[MasterState, Happened, Sequence[Command]], None]


@dataclass(frozen=True, slots=True)
class Difference:
    """One event after which the core decided otherwise than recorded.

    Attributes:
        elapsed: seconds since the beginning of the record.
        recorded, replayed: decisions, one line each.
    """

    elapsed: float
    recorded: tuple[str, ...]
    replayed: tuple[str, ...]

    def __str__(self) -> str:
        was, now = "; ".join(self.recorded) or "nothing", "; ".join(self.replayed) or "nothing"
        return f"after {self.elapsed:.3f} s: recorded {was}, replayed {now}"


@dataclass(frozen=True, slots=True)
class Replay:
    """The result of a replay.

    Attributes:
        decisions: number of recorded decisions.
        different: number of events after which the decisions differ from the recorded ones.
        differences: the first few of them.
        outcome: of the run, as recorded, up to the end of the measurement.
    """

    decisions: int
    different: int
    differences: tuple[Difference, ...]
    outcome: Outcome


def replay(
    recording: Recording, settings: CoreSettings, placement: PlacementPlugins,
    strategies: Mapping[str, MigrationStrategy], watcher: Watcher | None = None,
    until: float = inf, *, declared: Declared | None = None,
    chain_of: ChainOf | None = None,
) -> Replay:  # fmt: skip
    """Replay all events of a record in a core, at the same times.

    With the settings and plugins of the recorded master it decides the same. The events follow the
    record whatever is decided, so other settings only show where the first difference is.

    Args:
        recording: of a master's run.
        settings: of the master's core.
        placement: the policies and filters that judge hosts.
        strategies: by name.
        watcher: is called with each event and its commands.
        until: seconds from the beginning of the record: the run is measured up to here. All of it
            is replayed nonetheless.
        declared: declarations of the offers of the strategies.
        chain_of: returns the scoring policies with other settings, after a reload; None: they stay.
    """
    header = recording.header
    state = MasterState(settings, placement, strategies, header.epoch, declared=declared)
    state.chain_of = chain_of
    restore(state, lambda table: header.intents.get(table, {}), header.started)
    tail = header.intents.get("cluster", {}).get("tail")
    if tail is not None:
        journal_gap.begin(
            state, int(tail["newest"]), header.started, machine_rebooted=bool(tail["fell"])
        )
    end = header.started + min(until, recording.length)
    meter = Meter(end)
    meter.begin(state, header.started)
    outcome: Outcome | None = None
    count = different = 0
    differences: list[Difference] = []
    for one in recording.events:
        if one.now > end and outcome is None:
            outcome = meter.outcome(state, end)
        state.wall = one.wall
        commands = step(state, one.event, one.now)
        if outcome is None:
            meter.take(state, one.event, commands, one.now)
        if watcher is not None:
            watcher(state, one, commands)
        recorded, replayed = one.decided or (), decisions(commands)
        count += len(recorded)
        if recorded != replayed:
            different += 1
            if len(differences) < _TOLD:
                differences.append(Difference(one.now - header.started, recorded, replayed))
    return Replay(count, different, tuple(differences), outcome or meter.outcome(state, end))
