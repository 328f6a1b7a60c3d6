"""A recorded run as events and readings: the replay of `rosrm simulate` makes both."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from rosrm.core.master.commands import Command
from rosrm.core.master.master_state import MasterState
from rosrm.extensions.registry import Registry
from rosrm.model.records import Record
from rosrm.model.rows import EventRow
from rosrm.recording.encoding import Happened
from rosrm_report.model import Readings
from rosrm_simulate.meter import Curves
from rosrm_simulate.runs import load_record, replay_record

_CUT: Final = "cut short"


class RecordedRun(NamedTuple):
    """Events and readings of a record; `cut`: the record has no end."""

    events: Sequence[EventRow]
    readings: Readings
    cut: bool


def read_run(path: Path) -> RecordedRun:
    """Replay a record, of which a cut one counts as far as it goes.

    Raises:
        RecordError: it is damaged, or of another version.
        ConfigError, PluginError: a plugin that the record names is not installed.
    """
    recording = load_record(path, cut=True)
    events: list[EventRow] = []

    def watch(_: MasterState, happened: Happened, commands: Sequence[Command]) -> None:
        elapsed = happened.now - recording.header.started
        for one in commands:
            if isinstance(one, Record):
                facts = {**one.facts}
                if "decision" in facts:  # it is evaluated when it is read
                    facts["decision"] = dict(facts["decision"])
                events.append(
                    EventRow(
                        len(events) + 1, happened.wall, elapsed, one.kind, one.process, one.host,
                        one.message, facts,
                    )
                )  # fmt: skip

    replayed, _ = replay_record(recording, Registry.discover(), watcher=watch)
    outcome = replayed.outcome
    begin = events[0].elapsed if events else 0.0
    offset = outcome.first - recording.header.started - begin
    return RecordedRun(events, _readings_of(outcome.curves, offset), recording.end == _CUT)


def _readings_of(curves: Curves, offset: float) -> Readings:
    usage = {
        resource: {
            host: tuple(None if np.isnan(v) else float(v) for v in values[:, column])
            for column, host in enumerate(curves.hosts)
        }
        for resource, values in curves.usage.items()
        if not np.isnan(values).all()
    }
    limits = {
        resource: dict(zip(curves.hosts, map(float, curves.limit[resource]), strict=True))
        for resource in usage
    }
    return Readings(tuple(float(at) + offset for at in curves.times), usage, limits)
