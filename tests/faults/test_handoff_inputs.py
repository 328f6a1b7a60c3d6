"""Handoffs like those of test_handoff.py, of a node that answers inputs: none lost, none twice.

The victim is killed while inputs are in a buffer: of the destination, or of a silent source.
"""

from __future__ import annotations

import pytest

from tests.faults.handoff_scene import RATE, Scene, all_of
from tests.faults.handoff_watcher import blocks

pytestmark = pytest.mark.timeout(180)


@pytest.fixture(scope="module")
def scene(make_shared):
    """A scene whose node answers each input once."""
    one = Scene(make_shared, "echo", inputs=RATE)
    yield one
    one.close()


@pytest.mark.parametrize(
    ("victim", "moment"),
    [
        ("master", "says SWITCH"), ("master", "SILENT"), ("master", "ACTIVE"),
        ("master", "source stopping"), ("source's slave", "SILENT"),
        ("destination's slave", "SILENT"), ("source's slave", "ACTIVE"),
    ],
)  # fmt: skip
def test_master_or_slave_is_killed(scene, victim, moment):
    """The node answers each input once and in order."""
    scene.move((moment, scene.kill(victim)))
    scene.end(victim)
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize("moment", ["SHADOWING", "ATTACHED"])
def test_the_destination_is_killed_before_the_switch(scene, moment):
    """The source stays active and answers each input once and in order."""
    scene.move((moment, scene.kill("destination")))
    assert scene.end() == "stayed"
    assert scene.is_gapless(), scene.outputs


def test_the_destination_is_killed_in_the_switch(scene):
    """The source, already silent, answers its buffered inputs: each once and in order."""
    fault = all_of(scene.kill("destination"), scene.let_go("source"))
    scene.move(*scene.source_held(), ("SWITCHING", fault))
    assert scene.end() == "stayed"
    assert scene.is_gapless(), scene.outputs


@pytest.mark.parametrize("moment", ["says SWITCH", "SILENT", "RELEASED", "ACTIVE"])
def test_the_source_is_killed(scene, moment):
    """The successor answers all inputs that the source did not; only the last output may repeat."""
    scene.move((moment, scene.kill("source")))
    assert scene.end() == "moved"
    first, second = blocks(scene.outputs)
    again = second[0].answers == first[-1].answers
    assert again or second[0].answers == first[-1].answers + 1, (first[-9:], second[:9])
    for block in (first, second):
        numbers = [one.answers for one in block]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
