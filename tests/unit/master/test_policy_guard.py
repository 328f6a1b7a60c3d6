"""A policy that does not come back is ended, named, and left alone for a while."""

from __future__ import annotations

import contextlib
import time

import pytest

from rosrm.master.policy_guard import Deadline, GuardedScoring, guarded_checkpoints
from rosrm.ports import MemoryPacing


class Policy:
    """Does what a test says."""

    def __init__(self, act):
        self.act = act
        self.asked = 0

    def score(self, hosts, process):
        self.asked += 1
        return self.act()


def guarded(act, **options):
    policy = Policy(act)
    deadline = Deadline(**{"seconds": 0.1, "pause": 0.3, **options})
    return GuardedScoring(policy, deadline), policy


def spin():
    while True:
        pass


def swallow():
    """Takes no notice of what ends it, at first."""
    for _ in range(3):
        with contextlib.suppress(Exception):
            spin()
    spin()


def test_one_that_answers_is_passed_on() -> None:
    """With its answer or its error, and no alarm rings afterwards."""
    guard, _ = guarded(lambda: "scores")
    assert guard.score(None, None) == "scores"
    failing, _ = guarded(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        failing.score(None, None)
    time.sleep(0.15)


@pytest.mark.parametrize("act", [spin, lambda: time.sleep(100), swallow])
def test_one_that_hangs_is_ended(act) -> None:
    """Also one that sleeps, and one that swallows the error."""
    guard, _ = guarded(act)
    began = time.monotonic()
    with pytest.raises(TimeoutError, match=r"longer than 0\.1 s"):
        guard.score(None, None)
    assert time.monotonic() - began < 30.0
    time.sleep(0.15)  # no alarm is left


def test_one_that_hung_is_left_alone_for_a_while() -> None:
    """It costs its deadline once, not once for every reading that comes."""
    guard, policy = guarded(spin, pause=1.0)
    for _ in range(5):
        with pytest.raises(TimeoutError, match="not asked again"):
            guard.score(None, None)
    assert policy.asked == 1
    policy.act = lambda: "scores"
    time.sleep(1.05)
    assert guard.score(None, None) == "scores"
    assert policy.asked == 2


class Checkpoints:
    """A checkpoint policy that does as a test says."""

    def __init__(self, act):
        self.act = act

    def choose(self, process):
        return self.act()


class Paced(Checkpoints):
    """One that has memory dumped, too."""

    def pace(self, process):
        return self.act()


def test_each_policy_has_its_own_deadline() -> None:
    """One that was late does not keep another from being asked, or from being ended."""
    scoring, _ = guarded(spin)
    late = guarded_checkpoints(Checkpoints(spin), Deadline(0.1, 30.0))
    good = guarded_checkpoints(Checkpoints(lambda: "choice"), Deadline(0.1, 30.0))
    for ask in (lambda: scoring.score(None, None), lambda: late.choose(None)):
        with pytest.raises(TimeoutError):
            ask()
        assert good.choose(None) == "choice"


def test_a_guarded_policy_can_do_what_it_could() -> None:
    """The core asks by what it has; each call is guarded."""
    assert not isinstance(guarded_checkpoints(Checkpoints(spin), Deadline()), MemoryPacing)
    paced = guarded_checkpoints(Paced(spin), Deadline(0.1, 30.0))
    assert isinstance(paced, MemoryPacing)
    with pytest.raises(TimeoutError):
        paced.pace(None)
