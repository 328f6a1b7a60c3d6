"""Ledger of readings: received cycles, missed cycles, and the oldest reading."""

from __future__ import annotations

import numpy as np
import pytest

from rosrm.ros.master.reading_decoder import Runs
from rosrm.ros.master.reading_stats import ReadingStats

RUN = 500


def runs(*rows: tuple[int, int, int], incarnation: int = RUN, beat: int = 9) -> Runs:
    """Return runs from rows of (host id, sequence, cycles)."""
    hosts, sequences, cycles = (np.array(column, np.int64) for column in zip(*rows, strict=True))
    return Runs(
        hosts, np.full(len(rows), incarnation, np.uint64), sequences - cycles + 1, sequences,
        np.full(len(rows), beat, np.uint64), cycles,
    )  # fmt: skip


@pytest.fixture
def ledger() -> ReadingStats:
    made = ReadingStats()
    for host in (1, 2):
        made.begin(host, RUN)
    return made


def test_what_came_is_accounted_for(ledger: ReadingStats) -> None:
    """Cycles count, not messages; nothing is missed before the first message of a run."""
    ledger.take(runs((1, 40, 1), (2, 3, 3)), 0.0)
    ledger.take(runs((1, 42, 2)), 0.1)

    assert (ledger.cycles, ledger.missed) == (6, 0)


def test_a_gap_in_the_sequence_is_missed(ledger: ReadingStats) -> None:
    """Each cycle without a message counts."""
    ledger.take(runs((1, 1, 1)), 0.0)
    ledger.take(runs((1, 9, 2)), 0.1)

    assert (ledger.cycles, ledger.missed) == (3, 6)


def test_what_comes_late_is_missed_no_more(ledger: ReadingStats) -> None:
    """DDS may deliver in another order."""
    ledger.take(runs((1, 1, 1)), 0.0)
    ledger.take(runs((1, 4, 1)), 0.1)
    assert ledger.missed == 2
    ledger.take(runs((1, 3, 2)), 0.2)

    assert (ledger.cycles, ledger.missed) == (4, 0)
    ledger.take(runs((1, 5, 1)), 0.3)
    assert (ledger.cycles, ledger.missed) == (5, 0)


@pytest.mark.parametrize("host", [0, 3, 10_000_000])
def test_readings_of_an_unregistered_host_are_not_entered(ledger: ReadingStats, host: int) -> None:
    """A former run of a registered host is ignored, too."""
    assert ledger.take(runs((host, 5, 5)), 0.0).tolist() == []
    assert ledger.take(runs((1, 5, 5), incarnation=RUN + 1), 0.0).tolist() == []
    assert (ledger.cycles, ledger.missed) == (0, 0)
    assert ledger.ages(0.0) == (0, 0.0)


def test_another_run_of_a_slave_starts_its_own_statistics(ledger: ReadingStats) -> None:
    """The new run starts its sequence again and beats by another clock; the old counts stay."""
    ledger.take(runs((1, 100, 1), beat=10**15), 0.0)
    ledger.begin(1, RUN + 1)
    assert not ledger.beat[1]
    ledger.take(runs((1, 2, 2), incarnation=RUN + 1, beat=7), 0.1)

    assert ledger.beat[1] == 7
    assert (ledger.cycles, ledger.missed) == (3, 0)


def test_the_oldest_reading_is_that_of_the_most_silent_host(ledger: ReadingStats) -> None:
    """A host that left, or has been silent for long, is no longer awaited."""
    ledger.take(runs((1, 1, 1)), 0.0)
    ledger.take(runs((2, 1, 1)), 2.0)
    assert ledger.ages(3.0) == (2, 3.0)
    assert ledger.ages(11.0) == (1, 9.0)

    ledger.forget(2)
    assert ledger.ages(3.0) == (1, 3.0)


def test_the_books_grow(ledger: ReadingStats) -> None:
    """Existing counts stay."""
    ledger.take(runs((1, 7, 1), beat=3), 1.0)
    ledger.begin(5000, RUN)
    ledger.take(runs((5000, 1, 1), (1, 8, 1), beat=4), 1.5)

    assert ledger.beat[[1, 5000]].tolist() == [4, 4]
    assert (ledger.cycles, ledger.missed) == (3, 0)
    assert ledger.ages(2.0) == (2, 0.5)


@pytest.mark.parametrize("forged", [2**62, 2**63 - 1, -1, 10**6])
def test_a_forged_sequence_spoils_no_statistics(ledger: ReadingStats, forged: int) -> None:
    """The next messages of the slave count as before."""
    ledger.take(runs((1, 40, 1)), 0.0)
    ledger.take(runs((1, forged, 1)), 0.1)
    ledger.take(runs((1, 41, 1)), 0.2)
    ledger.take(runs((1, 43, 1)), 0.3)
    assert ledger.cycles == 4
    assert ledger.missed in (0, 1)


@pytest.mark.parametrize("forged", [2**64 - 1, 2**63, 20 * 10**9])
def test_a_beat_that_is_still_to_come_is_refused(ledger: ReadingStats, forged: int) -> None:
    """Orders with that beat would be stale for the slave."""
    ledger.take(runs((1, 40, 1), beat=10**9), 0.0)
    ledger.take(runs((1, 41, 1), beat=forged), 0.1)
    assert ledger.beat[1] == 10**9
    ledger.take(runs((1, 42, 1), beat=2 * 10**9), 1.0)
    assert ledger.beat[1] == 2 * 10**9


def test_a_beat_after_a_long_silence_counts(ledger: ReadingStats) -> None:
    """The slave's clock went on in that time; a wrong beat is replaced by an earlier one."""
    ledger.take(runs((1, 40, 1), beat=10**9), 0.0)
    ledger.take(runs((1, 41, 1), beat=101 * 10**9), 100.0)
    assert ledger.beat[1] == 101 * 10**9
    ledger.take(runs((1, 42, 1), beat=7), 100.1)
    assert ledger.beat[1] == 7


def test_beats_far_ahead_count_after_a_suspension(ledger: ReadingStats) -> None:
    """The machine of the master was suspended for an hour, and its clock stood still."""
    ledger.take(runs((1, 40, 1), beat=10**9), 0.0)
    for cycle in range(1, 17):
        beat = 3601 * 10**9 + cycle * 2 * 10**8
        ledger.take(runs((1, 40 + cycle, 1), beat=beat), 0.2 * cycle)
        assert ledger.beat[1] == (beat if cycle >= 16 else 10**9)
