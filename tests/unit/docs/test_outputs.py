"""Messages on pages, compared with those of the code; commands are followed elsewhere."""

from __future__ import annotations

from types import SimpleNamespace

from rosrm.core.slave.health import LOOK_PERIOD, InstanceHealth
from rosrm.core.slave.lifecycle_nodes import time_passed, transition_answered
from rosrm.core.slave.state import Steering
from rosrm.core.slave.watches import ManagedLifecycle, NoState, Observation, Watch
from rosrm.model.values import Health
from rosrm.wording import reload_summary
from tests.pages import TEXTS, masked, pages_with, texts


def shown(page: str) -> list[str]:
    """Return the lines of the only text block of a page."""
    (text,) = texts(page)
    return text.splitlines()


# --- health -----------------------------------------------------------------------------------

RATE = Watch(Health("~/scan", 5.0, "", 5.0), topics=("/robot/lidar/scan",))
STATE = Watch(Health("", 0.0, "active", 10.0), services=("/planner/get_state",))
STOPPED = Watch(Health("", 0.0, "", 30.0))


def verdict(watch: Watch, *, rate: float | None = None, **seen) -> str:
    """Return the verdict on a run of which each look finds the same, for at most a minute."""
    health = InstanceHealth(watch, 7, 0.0)
    for look in range(1, int(60 / LOOK_PERIOD)):
        now = look * LOOK_PERIOD
        counted = (
            {} if rate is None else {"messages": int(now * rate) - int((now - LOOK_PERIOD) * rate)}
        )
        found = health.look(Observation(**counted, **seen), now)
        if found:
            return found
    return ""


def test_the_page_about_health_shows_its_verdicts():
    """Durations and rates are examples; the rest of each line is the verdict of the check."""
    found = [
        verdict(RATE, rate=0.4),
        verdict(RATE, trouble="not published as /robot/lidar/scan"),
        verdict(STATE, state="inactive"),
        verdict(STATE, state=NoState.NO_ANSWER),
        verdict(STOPPED, stopped=True),
    ]
    page = shown("docs/how-to/health.md")
    assert [masked(line) for line in found] == [masked(line) for line in page]


# --- lifecycle --------------------------------------------------------------------------------


def test_the_page_about_lifecycle_nodes_shows_its_reasons():
    """`tests/unit/slave/test_lifecycle_nodes.py` has the words in front."""
    node = ManagedLifecycle("active", "/robot/lidar/get_state", "/robot/lidar/change_state", 30.0)

    def held(state="", transition=None):
        return SimpleNamespace(steering=Steering(0.0, 30.0, 0.0, state, transition), lifecycle=node)

    refused = SimpleNamespace(transition="configure", succeeded=False)
    faults = [
        transition_answered(held("unconfigured", "configure"), refused, 1.0).fault,
        time_passed(held("inactive", "activate"), 30.0).fault,
        time_passed(held(), 30.0).fault,
    ]
    assert [f"not ready: {fault}" for fault in faults] == shown("docs/how-to/lifecycle-nodes.md")


# --- reload -----------------------------------------------------------------------------------


def test_the_reference_shows_the_answer_to_a_reload():
    """The answer names the changed settings, and those that need a restart."""
    master, desk, _ = shown("docs/reference/command-line.md")
    assert master == f"the master: {reload_summary(['queue', 'scoring'], ['liveness.lease'])}"
    assert desk == f"desk: {reload_summary(['labels', 'limits'], [])}"


# --- the rest ---------------------------------------------------------------------------------


def test_every_page_with_a_text_block_names_its_test_or_the_reason():
    """The list in `tests/pages.py` contains every page."""
    assert pages_with("text") == set(TEXTS)
    assert all(TEXTS.values())
