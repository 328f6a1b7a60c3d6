"""A handoff does not go its way, and then somebody is killed as well.

The source is held before the master says SWITCH: so it cannot fall silent, and the step lasts until
its time is over, or until the source is killed.
"""

from __future__ import annotations

import pytest

from tests.faults.scenes import Scene, all_of
from tests.faults.watching import blocks

pytestmark = pytest.mark.timeout(180)


@pytest.fixture(scope="module")
def scene(make_shared):
    """A counter with a timer of its own; SWITCH is given up soon."""
    one = Scene(make_shared, "count", switch_timeout=1.5)
    yield one
    one.close()


@pytest.mark.parametrize("victim", ["master", "source's slave", "destination's slave"])
def test_killed_at_take_over(scene, victim):
    """The source has ended by then: its successor goes on where it was, and its host is told so."""
    scene.move(
        *scene.source_held(),
        ("SWITCHING", scene.kill("source")),
        ("says TAKE_OVER", scene.kill(victim)),
    )
    assert scene.end(victim) == "moved"
    first, second = blocks(scene.outputs)
    assert second[0].sequence in (first[-1].sequence, first[-1].sequence + 1)


def test_the_destination_is_killed_at_take_over(scene):
    """None is left: the process starts anew, by its policy."""
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
    """The source has counted on by then, or falls silent late; nothing is lost or repeated."""
    scene.move(
        *scene.source_held(),
        ("says ABORT", all_of(scene.kill(victim), scene.let_go("source"))),
    )
    scene.end(victim)  # the destination may be active before it hears of ABORT: then it has moved
    assert scene.is_gapless(), scene.outputs


def test_the_source_is_killed_at_abort(scene):
    """The destination is asked to give up and may do so: then the policy starts the process."""
    scene.move(*scene.source_held(), ("says ABORT", scene.kill("source")))
    scene.end()


@pytest.mark.parametrize("victim", ["master", "source's slave", "destination's slave"])
def test_killed_at_resume(scene, victim):
    """The destination has given up for good: the source goes on; nothing is lost or repeated."""
    scene.move(
        *scene.source_held(),
        ("says RESUME", all_of(scene.kill(victim), scene.let_go("source"))),
    )
    assert scene.end(victim) == "stayed"
    assert scene.is_gapless(), scene.outputs


def test_the_source_is_killed_at_resume(scene):
    """None is left: the process starts anew, by its policy."""
    scene.move(*scene.source_held(), ("says RESUME", scene.kill("source")))
    assert scene.end() == "stayed"


@pytest.mark.parametrize("victim", ["master", "source's slave"])
def test_killed_while_the_source_is_silent_and_alone(scene, victim):
    """The destination was killed as the source fell silent for it: that waits for RESUME."""
    scene.move(
        *scene.source_held(),
        ("SWITCHING", all_of(scene.kill("destination"), scene.let_go("source"))),
        ("says RESUME", scene.kill(victim)),
    )
    assert scene.end(victim) == "stayed"
    assert scene.is_gapless(), scene.outputs
