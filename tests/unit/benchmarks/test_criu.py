"""Evaluation of measured moves in `benchmarks.criu`."""

from __future__ import annotations

from benchmarks.criu import Outcome, beside, shared, table


def hop(**changes):
    """Return one move as the desk reports it."""
    parts = {
        "criu_checkpoint": {"prepare": 0.1, "leave": 0.05, "dump": 0.2, "offer": 0.1},
        "criu_fetch": {"transfer": 0.3},
        "criu_await_restored": {"restore": 0.4},
        "criu_join": {"join": 0.5, "node_enter": 0.4},
    }
    plain = {
        "strategy": "criu", "mb": 10.0, "end": "migrated", "why": "", "silence": 1.5,
        "seconds": 2.0, "parts": parts, "repeated": 0, "missed": 0, "checksums": [7],
        "restarted": False,
    }  # fmt: skip
    return {**plain, **changes}


def test_the_parts_of_a_move_are_those_of_its_executors():
    """The offer belongs to the transfer; times reported by a node are within its join."""
    figures = Outcome([hop(), hop(silence=2.5)]).figures()
    assert figures["transfer_p50_s"] == 0.4
    assert figures["rejoin_p50_s"] == 0.5
    assert (figures["blackout_p50_s"], figures["blackout_p99_s"]) == (2.5, 2.5)
    assert (figures["hops"], figures["failures"], figures["heap_ok"]) == (2, 0, True)


def test_a_move_that_failed_counts_as_that_alone():
    """The silence of a failed move is no blackout."""
    outcome = Outcome([hop(), hop(end="stayed", why="the disk is full", silence=9.0, parts={})])
    assert outcome.failures == ["the disk is full"]
    assert outcome.silences() == [1.5]
    assert outcome.figures()["dump_p99_s"] == 0.2


def test_a_heap_that_was_ever_another_one_is_not_the_same():
    """A heap without any checksum does not count as the same either."""
    assert not Outcome([hop(), hop(checksums=[8])]).heap_ok
    assert not Outcome([hop(checksums=[])]).heap_ok


def test_most_moves_are_of_the_first_heap():
    """The total is as requested, if that is enough for one move of each heap."""
    assert shared(50, [10.0, 100.0, 500.0]) == [30, 10, 10]
    assert shared(4, [10.0]) == [4]
    assert shared(1, [10.0, 100.0]) == [1, 1]


def test_the_table_has_all_strategies():
    """The table has the loss of each strategy."""
    others = {
        "relaunch": beside([hop(strategy="relaunch", restarted=True)], "relaunch"),
        "handoff": beside([hop(strategy="handoff")], "handoff"),
    }
    lines = table({"10": Outcome([hop()]).figures()}, others).splitlines()
    assert [line.rpartition("  ")[2] for line in lines[1:]] == [
        "nothing", "count and memory", "nothing of its state",
    ]  # fmt: skip
