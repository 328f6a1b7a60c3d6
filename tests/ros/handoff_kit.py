"""Helpers of the tests of handoffs on real DDS."""

from __future__ import annotations

from rosrm_msgs.msg import HandoffReport, StateConfig


def numbers(heard):
    return [message.data for message in heard]


def is_gapless(counts):
    """Return True if the counts have come in order, without a gap or a repetition."""
    return numbers(counts) == list(range(counts[0].data, counts[-1].data + 1))


def goes_on(stage, heard, more=5):
    """Wait until `more` further messages arrive."""
    before = len(heard)
    stage.spin_until(lambda: len(heard) >= before + more, "further counts")


def shadowing(stage, pair, text):
    """Check that the shadow reports its unmet condition, and not READY."""
    pair.conductor.say(StateConfig.SHADOW)
    reports = pair.conductor.reports
    stage.spin_until(lambda: any(text in one.message for one in reports), f"a wait {text}")
    before = len(pair.counts)
    stage.spin_until(lambda: len(pair.counts) > before + 60, "time to become ready")
    assert HandoffReport.READY not in pair.conductor.of(2)


def fails(stage, pair, text, *, of=2):
    """Check that the handoff fails with a message, and the source continues."""
    pair.conductor.say(StateConfig.SHADOW)
    report = pair.conductor.wait(of, HandoffReport.FAILED)
    assert text in report.message
    assert len(report.message) < 2000, "the master drops far longer texts"
    goes_on(stage, pair.counts)
    assert HandoffReport.READY not in pair.conductor.of(2)
