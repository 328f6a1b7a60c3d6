"""Handoffs that fail, with a participant killed on top.

The source is paused before the master says SWITCH. The source cannot fall silent, so the step lasts
until its timeout, or until the source is killed.
"""

from __future__ import annotations

import pytest

from tests.faults.handoff_scene import Scene, all_of
from tests.faults.handoff_watcher import blocks

pytestmark = pytest.mark.timeout(180)


@pytest.fixture(scope="module")
def scene(make_shared):
    """A scene whose process counts by a timer; SWITCH times out after 1.5 s."""
    one = Scene(make_shared, switch_timeout=1.5)
    yield one
    one.close()


@pytest.mark.parametrize("victim", ["master", "source's slave", "destination's slave"])
def test_killed_at_take_over(scene, victim):
    """The source is dead: its successor continues the count, and its slave is informed."""
    scene.move(
        *scene.source_held(),
        ("SWITCHING", scene.kill("source")),
        ("says TAKE_OVER", scene.kill(victim)),
    )
    assert scene.end(victim) == "moved"
    first, second = blocks(scene.outputs)
    assert second[0].sequence in (first[-1].sequence, first[-1].sequence + 1)


def test_the_destination_is_killed_at_take_over(scene):
    """No instance is left: the restart policy starts the process from its initial state."""
    scene.move(
        *scene.source_held(),
        ("SWITCHING", scene.kill("source")),
        ("says TAKE_OVER", scene.kill("destination")),
    )
    scene.end()


@pytest.mark.parametrize(
    "victim", ["master", "source's slave", "destination's slave", "destination"]
)
def test_killed_at_abort(scene, victim):
    """The source has resumed by then, or falls silent late; no output is lost or repeated."""
    scene.move(
        *scene.source_held(),
        ("says ABORT", all_of(scene.kill(victim), scene.let_go("source"))),
    )
    scene.end(victim)  # a destination that is active before ABORT arrives has moved
    assert scene.is_gapless(), scene.outputs


def test_the_source_is_killed_at_abort(scene):
    """The destination may give up on ABORT: then the restart policy starts the process."""
    scene.move(*scene.source_held(), ("says ABORT", scene.kill("source")))
    scene.end()


@pytest.mark.parametrize("victim", ["master", "source's slave", "destination's slave"])
def test_killed_at_resume(scene, victim):
    """The destination has given up for good: the source resumes; no output is lost or repeated."""
    scene.move(
        *scene.source_held(),
        ("says RESUME", all_of(scene.kill(victim), scene.let_go("source"))),
    )
    assert scene.end(victim) == "stayed"
    assert scene.is_gapless(), scene.outputs


def test_the_source_is_killed_at_resume(scene):
    """No instance is left: the restart policy starts the process from its initial state."""
    scene.move(*scene.source_held(), ("says RESUME", scene.kill("source")))
    assert scene.end() == "stayed"


@pytest.mark.parametrize("victim", ["master", "source's slave"])
def test_killed_while_the_source_is_silent_and_alone(scene, victim):
    """A source that fell silent for a destination killed just then waits for RESUME."""
    scene.move(
        *scene.source_held(),
        ("SWITCHING", all_of(scene.kill("destination"), scene.let_go("source"))),
        ("says RESUME", scene.kill(victim)),
    )
    assert scene.end(victim) == "stayed"
    assert scene.is_gapless(), scene.outputs
