"""Every participant of a handoff is killed at each of its steps: "moved" or "stayed", one active.

The words of the protocol are heard from outside, and the victim is killed with SIGKILL as soon as
one of them is. A killed master or slave is started again, as its service manager would. A moment is
left out where a victim neither does nor awaits anything new in it.
"""

from __future__ import annotations

import pytest

from tests.faults.scenes import Scene
from tests.faults.watching import blocks

pytestmark = pytest.mark.timeout(180)

#: In their order. "says" is the master's word; others are reported by a node, or by a slave of
#: the "source" or the "destination".
MOMENTS = [
    "destination starting", "source policy", "says SHADOW", "SHADOWING", "ATTACHED", "READY",
    "says SWITCH", "SWITCHING", "SILENT", "RELEASED", "ACTIVE", "destination policy",
    "source stopping", "says DONE",
]  # fmt: skip
#: From here on the destination may have become active before the blow falls.
MAY_BE_ACTIVE = MOMENTS[MOMENTS.index("READY") :]
#: From here on the move is written down.
COMMITTED = MOMENTS[MOMENTS.index("destination policy") :]


@pytest.fixture(scope="module")
def scene(make_shared):
    """A counter with a timer of its own."""
    one = Scene(make_shared, "count")
    yield one
    one.close()


@pytest.fixture(scope="module")
def deaf(make_shared):
    """As `scene`, but SIGKILL alone ends it."""
    one = Scene(make_shared, "count", module="tests.ros.programs.deaf")
    yield one
    one.close()


def strike(scene: Scene, victim: str, moment: str) -> str:
    """Kill somebody at a moment; how the move has ended."""
    scene.move((moment, scene.kill(victim)))
    end = scene.end(victim)
    assert end == "moved" or moment not in COMMITTED
    return end


@pytest.mark.parametrize(
    "moment", [one for one in MOMENTS if one not in ("SHADOWING", "ATTACHED", "SWITCHING")]
)
def test_the_master_is_killed(scene, moment):
    """Nothing is lost or repeated: it goes on with the step in hand, or undoes it."""
    strike(scene, "master", moment)
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize(
    ("whose", "moment"),
    [
        ("source", "destination starting"), ("source", "source policy"), ("source", "says SHADOW"),
        ("source", "says SWITCH"), ("source", "RELEASED"), ("source", "source stopping"),
        ("source", "says DONE"), ("destination", "destination starting"),
        ("destination", "says SHADOW"), ("destination", "READY"), ("destination", "says SWITCH"),
        ("destination", "ACTIVE"), ("destination", "source stopping"),
        ("destination", "says DONE"),
    ],
)  # fmt: skip
def test_a_slave_is_killed(scene, whose, moment):
    """Its processes run on; nothing is lost or repeated."""
    strike(scene, f"{whose}'s slave", moment)
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize("moment", ["destination running", *MOMENTS[3:]])
def test_the_destination_is_killed(scene, moment):
    """Before it is active the source goes on without a gap; after it, somebody does."""
    strike(scene, "destination", moment)
    if moment not in MAY_BE_ACTIVE:
        assert scene.is_gapless(), scene.outputs
        assert len(blocks(scene.outputs)) == 1


@pytest.mark.parametrize("moment", MOMENTS[:11])
def test_the_source_is_killed(scene, moment):
    """From SWITCH on its state is not lost; before, its policy starts it again."""
    strike(scene, "source", moment)
    speakers = blocks(scene.outputs)
    assert len(speakers) <= 2, speakers
    if moment in MAY_BE_ACTIVE:
        first, second = speakers
        # Killed in the middle of a cycle, its last output may be said again.
        assert second[0].sequence in (first[-1].sequence, first[-1].sequence + 1)


def test_a_source_that_will_not_die_is_killed(deaf):
    """SIGINT and SIGTERM do not reach it: SIGKILL ends it after its grace."""
    deaf.move(("source stopping", deaf.leave_alone))
    assert deaf.end() == "moved"
    assert deaf.is_gapless()


@pytest.mark.parametrize("victim", ["master", "source's slave"])
def test_a_source_that_will_not_die_outlives_who_orders_its_end(deaf, victim):
    """The order stands: the supervisor goes on, or it is given once more."""
    deaf.move(("source stopping", deaf.kill(victim)))
    assert deaf.end(victim) == "moved"
    assert deaf.is_gapless()
