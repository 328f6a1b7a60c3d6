"""Records that the journal may have lost before the master started."""

from __future__ import annotations

from dataclasses import dataclass

from rosrm.model.values import LARGEST_NUMBER


@dataclass(slots=True)
class JournalGap:
    """Records that the journal may have lost before this master started.

    Attributes:
        newest: sequence of the newest record at the start.
        started: time of the start.
        machine_rebooted: True if the machine had rebooted, until every host has rejoined or is
            lost.
        lost: number of records that are known to be lost.
        records_missing: True if records are lost, until one lease after the start.
    """

    newest: int = LARGEST_NUMBER
    started: float = 0.0
    machine_rebooted: bool = False
    lost: int = 0
    records_missing: bool = False
