"""Reports of hand-made events."""

from __future__ import annotations

from dataclasses import replace

from rosrm.timeline.values import HostSpan, Move, Placement, Start, Wait
from rosrm_report.extract import report_of
from rosrm_report.model import CloseDecision, Material
from rosrm_report.page import page_of, summary
from tests.unit.tools.report.runs import READINGS, decision, events, report


def test_a_process_is_on_its_host_from_its_assignment_to_its_end():
    """The wait before it, and the start within it, are told apart."""
    made = report(
        (0, "submitted", "p"), (1, "waits", "p", "", "p waits: no host can take it now"),
        (4, "assigned", "p", "a", "", {"number": 7}), (5, "starting", "p", "a"),
        (6, "ready", "p", "a"), (9, "finished", "p", "a"),
    )  # fmt: skip

    assert made.placements == (Placement("p", "a", 4.0, 9.0, 7, "finished"),)
    assert made.waits == (Wait("p", 0.0, 4.0, "p waits: no host can take it now"),)
    assert made.starts == (Start("p", "a", 4.0, 2.0),)
    assert made.outcomes == {"p": "finished"}
    assert made.queue == ((0.0, 1), (4.0, 0))


def test_a_process_without_an_end_runs_or_waits_to_the_end_of_the_report():
    """The run may still continue when the report is made."""
    made = report(
        (0, "submitted", "p"), (0, "submitted", "q"), (1, "assigned", "p", "a", "", {"number": 1}),
        (5, "host_cordoned", "", "a"),
    )  # fmt: skip

    assert made.placements == (Placement("p", "a", 1.0, 5.0, 1),)
    assert made.waits[-1] == Wait("q", 0.0, 5.0, over=False)
    assert made.outcomes == {"p": "running", "q": "waiting"}


def test_a_migration_is_a_move_with_its_cause():
    """The destination has the process from the end of the migration on."""
    facts = {"from": "a", "to": "b", "seconds": 2.0, "cause": "a is over", "strategy": "handoff"}
    made = report(
        (0, "assigned", "p", "a", "", {"number": 1}),
        (1, "migration_begun", "p", "b", "", {"destination": 2}),
        (3, "migrated", "p", "b", "p moved", facts), (9, "cancelled", "p", "b"),
    )  # fmt: skip

    assert made.moves == (Move(3.0, "p", "a", "b", "handoff", "a is over", 2.0),)
    assert made.placements == (
        Placement("p", "a", 0.0, 3.0, 1, "migrated"),
        Placement("p", "b", 3.0, 9.0, 2, "cancelled"),
    )
    assert [(one.host, one.moves_from, one.moves_to) for one in made.hosts] == [
        ("a", 1, 0), ("b", 0, 1),
    ]  # fmt: skip


def test_a_migration_within_a_host_is_a_replacement():
    """Each instance has its time on the host; the host's figures count no move."""
    facts = {"from": "a", "to": "a", "cause": "version 2", "strategy": "handoff", "seconds": 1}
    made = report(
        (0, "assigned", "p", "a", "", {"number": 1}),
        (1, "migration_begun", "p", "a", "", {"destination": 2}),
        (3, "migrated", "p", "a", "", facts), (9, "cancelled", "p", "a"),
    )  # fmt: skip

    assert made.placements == (
        Placement("p", "a", 0.0, 3.0, 1, "migrated"),
        Placement("p", "a", 3.0, 9.0, 2, "cancelled"),
    )
    assert made.hosts[0].moves_to == made.hosts[0].moves_from == 0
    assert "no moves" in summary(made)
    assert "replaced on their host" in page_of(made)


def test_a_migration_that_failed_leaves_the_process_where_it_was():
    """The migration is listed with the reason and counts for no host."""
    facts = {"from": "a", "to": "b", "seconds": 1.0, "cause": "drained", "strategy": "relaunch"}
    made = report(
        (0, "assigned", "p", "a", "", {"number": 1}),
        (1, "stayed", "p", "a", "p stays on a: b is lost", facts), (2, "finished", "p", "a"),
    )  # fmt: skip

    (move,) = made.moves
    assert (move.done, move.cause) == (False, "p stays on a: b is lost")
    assert made.placements == (Placement("p", "a", 0.0, 2.0, 1, "finished"),)
    assert made.hosts[0].moves_from == 0


def test_a_process_of_a_lost_host_moves_by_a_start_elsewhere():
    """The cause is the loss, and the host is gone until it reports again."""
    made = report(
        (0, "assigned", "p", "a", "", {"number": 1}), (1, "running", "p", "a"),
        (5, "host_lost", "", "a", "a is lost"),
        (5, "given_up", "p", "a", "p#1 is given up: a is lost", {"number": 1}),
        (5, "queued", "p", "a", "p returns to the queue: a is lost"),
        (6, "assigned", "p", "b", "", {"number": 2}), (8, "host_back", "", "a"),
        (9, "finished", "p", "b"),
    )  # fmt: skip

    assert made.moves == (Move(6.0, "p", "a", "b", "restart", "p#1 is given up: a is lost"),)
    assert made.gone == (HostSpan("a", "lost", 5.0, 8.0),)
    assert [(one.kind, one.level) for one in made.faults] == [
        ("host_lost", "ERROR"), ("given_up", "ERROR"),
    ]  # fmt: skip
    assert [one.seconds for one in made.waits] == [1.0]


def test_failures_have_the_instance_whose_log_has_the_reason():
    """A restart is a failure, too; a failure is no fault beside."""
    made = report(
        (0, "assigned", "p", "a", "", {"number": 4}),
        (1, "backoff", "p", "a", "p is in back-off on a: exit code 1", {"number": 4}),
        (2, "ready", "p", "a"), (3, "failed", "p", "a", "p failed on a: \x1b[31mexit code 2"),
    )  # fmt: skip

    assert [(one.time, one.number, one.restarts) for one in made.failures] == [
        (1.0, 4, True), (3.0, 4, False),
    ]  # fmt: skip
    assert made.failures[1].message == "p failed on a: ?[31mexit code 2"
    assert made.faults == ()
    assert made.hosts[0].failures == 2


def test_only_decisions_between_nearly_equal_hosts_are_close():
    """The second best counts; a host that cannot take the process does not."""
    made = report(
        (0, "assigned", "p", "a", "", decision(a=0.50, b=0.52, c=0.9, d=None)),
        (1, "assigned", "q", "a", "", decision(a=0.50, b=0.60)),
        (2, "assigned", "r", "a", "", decision(a=0.50, b=None)),
    )  # fmt: skip

    assert made.close_decisions == (CloseDecision(0.0, "p", "a", 0.50, "b", 0.52),)


def test_the_time_over_limits_is_counted_for_each_host():
    """All limits of a host end together, and a lost host is over none."""
    made = report(
        (1, "over_limit", "", "a", "", {"resource": "memory"}),
        (2, "over_limit", "", "a", "", {"resource": "cpu"}), (4, "under_limit", "", "a"),
        (5, "over_limit", "", "b", "", {"resource": "memory"}), (7, "host_lost", "", "b"),
        (9, "host_registered", "", "b"), readings=READINGS,
    )  # fmt: skip

    assert [one.over_limit for one in made.hosts] == [5.0, 2.0]
    assert [one.peaks["memory"] for one in made.hosts] == [0.9, 0.3]


def test_what_is_missing_is_said_in_a_sentence():
    """No readings, no events, and a journal without its beginning."""
    late = [replace(one, sequence=41) for one in events((0, "submitted", "p"))]

    assert report().notes == (
        "No events: nothing is known about this run.",
        "The source has no readings, so the usage of the hosts is not shown.",
    )
    assert report_of(Material("j", late, READINGS)).notes == (
        "The journal no longer has the first 40 events: the report begins after those.",
    )


def test_facts_of_a_damaged_event_are_left_out():
    """The rest of the event still counts."""
    bad = {"unreadable": "{", "number": "x", "decision": 3, "seconds": "long", "destination": None}
    made = report(
        (0, "assigned", "p", "a", "", bad), (1, "migration_begun", "p", "b", "", bad),
        (2, "migrated", "p", "b", "", bad), (3, "failed", "p", "b", "", bad),
    )  # fmt: skip

    assert [one.host for one in made.placements] == ["a", "b"]
    assert made.failures[0].number == 0


def test_the_next_run_of_a_job_on_another_host_is_no_move():
    """A finished run is not moved."""
    made = report(
        (0, "assigned", "p", "a", "", {"number": 1}), (1, "finished", "p", "a"),
        (5, "queued", "p", "", "p is queued for its run at 02:00"), (6, "assigned", "p", "b"),
    )  # fmt: skip

    assert made.moves == ()
