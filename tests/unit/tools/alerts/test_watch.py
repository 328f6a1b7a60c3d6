"""Alerts begin and end as the table of the watch says."""

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm_alerts.conditions import (
    Above,
    Alert,
    Happens,
    HostLost,
    InState,
    NoAnswer,
    SeenEvent,
    SeenHost,
    SeenProcess,
    SeenResource,
    Situation,
)
from rosrm_alerts.watch import Subject, Watch

HOT = Alert("hot", Above("memory", 0.9), lasts=30.0)
RUNS = InState(frozenset({"running"}))
AT_REST = Situation({"h1": SeenHost()})


def usage(share: float, limit: float = 1.0, name: str = "h1") -> Situation:
    return Situation({name: SeenHost("up", {"memory": SeenResource(share, limit)})})


def host(state: str) -> Situation:
    return Situation({"h1": SeenHost(state)})


def process(state: str) -> Situation:
    return Situation(processes={"p": SeenProcess(state)})


def told(changes) -> list[tuple[str, str, str]]:
    return [(one.alert.name, one.kind, str(one.subject)) for one in changes]


def test_an_alert_begins_once_its_condition_has_held_for_its_time():
    """Not before, and once; it ends when the condition does not hold."""
    watch = Watch([HOT])

    assert told(watch.observe(0.0, usage(0.95))) == []
    assert watch.next_change() == 30.0
    assert told(watch.observe(29.9, usage(0.95))) == []
    assert told(watch.observe(30.0, usage(0.95))) == [("hot", "begins", "h1")]
    assert told(watch.observe(31.0, usage(0.95))) == []
    assert watch.next_change() == inf
    assert told(watch.observe(32.0, usage(0.9))) == [("hot", "ends", "h1")]


def test_a_gap_restarts_the_time():
    """A condition that did not hold in between has not held for the time."""
    watch = Watch([HOT])

    watch.observe(0.0, usage(0.95))
    watch.observe(20.0, usage(0.5))
    watch.observe(21.0, usage(0.95))

    assert told(watch.observe(40.0, usage(0.95))) == []
    assert told(watch.observe(51.0, usage(0.95))) == [("hot", "begins", "h1")]


def test_a_silent_master_changes_no_alert_but_its_own():
    """States that cannot be seen neither begin nor end alerts."""
    watch = Watch([HOT, Alert("silent", NoAnswer())])
    watch.observe(0.0, usage(0.95))
    watch.observe(30.0, usage(0.95))

    assert told(watch.observe(31.0, None)) == [("silent", "begins", "the cluster")]
    assert told(watch.observe(32.0, usage(0.95))) == [("silent", "ends", "the cluster")]


@pytest.mark.parametrize(
    ("condition", "holds", "unknown", "over"),
    [
        (Above("memory"), usage(0.81, 0.8), AT_REST, usage(0.7)),
        (Above("memory"), usage(0.81, 0.8), AT_REST, Situation()),
        (HostLost(), host("lost"), host("expected"), host("up")),
        (HostLost(), host("lost"), host("expected"), Situation()),
        (RUNS, process("running"), process("unknown"), process("queued")),
        (RUNS, process("running"), process("unknown"), Situation()),
    ],
)
def test_an_alert_ends_only_once_its_condition_is_known(condition, holds, unknown, over):
    """A stale reading or a silent host leaves it unknown; an unlisted host or process is gone."""
    watch = Watch([Alert("seen", condition)])
    ((_, begins, of),) = told(watch.observe(0.0, holds))

    assert begins == "begins"
    assert told(watch.observe(1.0, unknown)) == []
    assert told(watch.observe(2.0, holds)) == []
    assert told(watch.observe(3.0, unknown)) == []
    assert told(watch.observe(4.0, over)) == [("seen", "ends", of)]


def test_an_alert_that_is_due_while_nothing_is_known_begins_later():
    """A test of alerts advances to the next change, and must not wait for this one for ever."""
    watch = Watch([HOT])
    watch.observe(0.0, usage(0.95))

    assert told(watch.observe(30.0, None)) == []
    assert watch.next_change() == inf
    assert told(watch.observe(40.0, usage(0.95))) == [("hot", "begins", "h1")]


def test_conditions_choose_by_patterns():
    """Each host and process that matches has an alert of its own."""
    lost = Alert("lost", HostLost("robot-*"))
    stuck = Alert("stuck", InState(frozenset({"queued"}), "nav_*", "nav"))
    situation = Situation(
        {"robot-1": SeenHost("lost"), "edge": SeenHost("lost"), "robot-2": SeenHost("up")},
        {
            "nav_a": SeenProcess("queued", "nav", "no host fits"),
            "nav_b": SeenProcess("running", "nav"),
            "nav_c": SeenProcess("queued", "other"),
            "map": SeenProcess("queued", "nav"),
        },
    )

    changes = Watch([lost, stuck]).observe(0.0, situation)

    assert told(changes) == [("lost", "begins", "robot-1"), ("stuck", "begins", "nav_a")]
    assert changes[1].message == "nav_a is queued (no host fits)"


def test_each_event_begins_an_alert_that_does_not_end():
    """An event has no end."""
    watch = Watch([Alert("failed", Happens(frozenset({"failed"}), application="nav"))])
    there = Situation(processes={"p": SeenProcess("failed", "nav"), "q": SeenProcess("failed")})
    events = [
        SeenEvent("failed", "p", "h", "p failed"),
        SeenEvent("failed", "q"),
        SeenEvent("ready"),
    ]

    assert told(watch.observe(0.0, there, events)) == [("failed", "begins", "p")]
    assert told(watch.observe(1.0, there, events[:1])) == [("failed", "begins", "p")]
    assert watch.active == {}


def test_repeated_events_begin_an_alert_and_their_age_ends_it():
    """Three restarts of one process within a minute; two processes are counted apart."""
    loop = Alert("loop", Happens(frozenset({"backoff"}), count=3, within=60.0))
    watch, event = Watch([loop]), SeenEvent("backoff", "p")

    assert told(watch.observe(0.0, AT_REST, [event, SeenEvent("backoff", "q")])) == []
    assert told(watch.observe(10.0, AT_REST, [event])) == []
    assert told(watch.observe(20.0, AT_REST, [event])) == [("loop", "begins", "p")]
    assert told(watch.observe(59.0, AT_REST, [])) == []
    assert told(watch.observe(60.0, AT_REST, [])) == [("loop", "ends", "p")]


def test_a_restarted_watch_does_not_begin_again():
    """Alerts that were active stay active, and end as usual."""
    watch = Watch([HOT], {("hot", Subject(host="h1")): 5.0, ("gone", Subject()): 1.0})

    assert told(watch.observe(100.0, usage(0.95))) == []
    assert told(watch.observe(101.0, usage(0.1))) == [("hot", "ends", "h1")]


@given(
    st.lists(
        st.tuples(st.floats(0.1, 20.0), st.sampled_from([0.5, 0.95, None])), min_size=1, max_size=60
    )
)
def test_an_alert_is_active_exactly_while_its_condition_has_held_long_enough(observed):
    """Begin and end alternate, and agree with a direct reading of the history."""
    watch, now, active, since = Watch([HOT]), 0.0, False, None
    for pause, share in observed:
        now += pause
        changes = watch.observe(now, None if share is None else usage(share))
        if share is not None:
            since = (now if since is None else since) if share > 0.9 else None
        wanted = active if share is None else since is not None and now - since >= HOT.lasts
        assert [one.kind for one in changes] == (
            [] if wanted == active else ["begins" if wanted else "ends"]
        )
        active = wanted
        assert bool(watch.active) == active
