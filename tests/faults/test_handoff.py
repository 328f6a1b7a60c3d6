"""Handoffs in which each participant is killed at each step: "moved" or "stayed", one active.

The moved node counts by a timer and answers inputs: none may be lost or answered twice.
A watcher outside the cluster receives the protocol's messages, and the victim is killed with
SIGKILL as soon as the given one arrives. A killed master or slave is restarted, as its service
manager would. A moment is left out where the victim neither acts nor waits for a new message.
"""

from __future__ import annotations

import pytest

from tests.faults.handoff_scene import RATE, Scene, all_of
from tests.faults.handoff_watcher import answered_by, blocks, is_gapless

pytestmark = pytest.mark.timeout(180)

#: In order. "says X" is a message of the master; the others are reported by a node, or by the slave
#: of the "source" or the "destination".
MOMENTS = [
    "destination running", "source policy", "says SHADOW", "SHADOWING", "ATTACHED", "READY",
    "says SWITCH", "SWITCHING", "SILENT", "RELEASED", "ACTIVE", "destination policy",
    "source stopping", "says DONE",
]  # fmt: skip
#: From here on the destination may have become active before the victim is killed.
MAY_BE_ACTIVE = MOMENTS[MOMENTS.index("READY") :]
#: From here on the migration is in the journal.
COMMITTED = MOMENTS[MOMENTS.index("destination policy") :]


@pytest.fixture(scope="module")
def scene(make_shared):
    """A scene whose node counts by a timer, and answers each input once."""
    one = Scene(make_shared, "tests.ros.programs.counts_and_answers", inputs=RATE)
    yield one
    one.close()


@pytest.fixture(scope="module")
def stubborn(make_shared):
    """A scene whose node counts by a timer, and ends by SIGKILL only."""
    one = Scene(make_shared, "tests.ros.programs.blocks_signals")
    yield one
    one.close()


def inject(scene: Scene, victim: str, moment: str) -> str:
    """Kill the victim at a moment; return "moved" or "stayed"."""
    scene.move((moment, scene.kill(victim)))
    end = scene.end(victim)
    assert end == "moved" or moment not in COMMITTED
    return end


@pytest.mark.parametrize(
    "moment", [one for one in MOMENTS if one not in ("SHADOWING", "ATTACHED", "SWITCHING")]
)
def test_the_master_is_killed(scene, moment):
    """No output or input is lost or repeated: the next master continues the step, or undoes it."""
    inject(scene, "master", moment)
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize(
    ("whose", "moment"),
    [
        ("source", "destination running"), ("source", "source policy"), ("source", "says SHADOW"),
        ("source", "says SWITCH"), ("source", "SILENT"), ("source", "RELEASED"),
        ("source", "ACTIVE"), ("source", "source stopping"), ("source", "says DONE"),
        ("destination", "destination running"), ("destination", "says SHADOW"),
        ("destination", "READY"), ("destination", "says SWITCH"), ("destination", "SILENT"),
        ("destination", "ACTIVE"), ("destination", "source stopping"),
        ("destination", "says DONE"),
    ],
)  # fmt: skip
def test_a_slave_is_killed(scene, whose, moment):
    """The processes on the slave's host keep running; no output or input is lost or repeated."""
    inject(scene, f"{whose}'s slave", moment)
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize("moment", ["destination running", *MOMENTS[3:]])
def test_the_destination_is_killed(scene, moment):
    """The source continues without a gap, or, once the destination is active, a successor."""
    inject(scene, "destination", moment)
    if moment not in MAY_BE_ACTIVE:
        assert scene.is_gapless(), scene.outputs
        assert len(blocks(scene.outputs)) == 1


def test_the_destination_is_killed_in_the_switch(scene):
    """The source, already silent, serves its buffered inputs: each once and in order."""
    fault = all_of(scene.kill("destination"), scene.let_go("source"))
    scene.move(*scene.source_held(), ("SWITCHING", fault))
    assert scene.end() == "stayed"
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize("moment", MOMENTS[:11])
def test_the_source_is_killed(scene, moment):
    """From SWITCH on the source's state is not lost; before, its restart policy starts it again."""
    inject(scene, "source", moment)
    speakers = blocks(scene.outputs)
    assert len(speakers) <= 2, speakers
    if moment in MAY_BE_ACTIVE:
        first, second = speakers
        # A source killed in the middle of a cycle may have its last output repeated.
        assert second[0].sequence in (first[-1].sequence, first[-1].sequence + 1)
        assert is_gapless(first)
        assert is_gapless(second)
        last, following = answered_by(first)[-1], answered_by(second)[0]
        assert following in (last, last + 1)


def test_a_source_that_ignores_signals_is_killed(stubborn):
    """The source blocks SIGINT and SIGTERM; SIGKILL ends it after its grace periods."""
    stubborn.move(("source stopping", stubborn.leave_alone))
    assert stubborn.end() == "moved"
    assert stubborn.is_gapless()


@pytest.mark.parametrize("victim", ["master", "source's slave"])
def test_a_stop_is_continued_when_its_sender_is_killed(stubborn, victim):
    """The supervisor continues the stop, or gets the order again from the restarted part."""
    stubborn.move(("source stopping", stubborn.kill(victim)))
    assert stubborn.end(victim) == "moved"
    assert stubborn.is_gapless()
