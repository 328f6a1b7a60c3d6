"""Failure messages of the contracts; a hanging plugin cannot block its tests."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass
from types import SimpleNamespace
from unittest import SkipTest

import pytest

from rosrm.errors import SkipPlugin
from rosrm.extensions.contracts import (
    CheckpointChoice,
    CheckpointOffer,
    MigrationOffer,
    ProbeOffer,
    Scores,
    ScoringOffer,
)
from rosrm.extensions.units import Bytes, PositiveSeconds
from rosrm.model.plan import Execute, Plan, Start
from rosrm.testing import (
    CheckpointContract,
    FakeProbe,
    MigrationContract,
    ProbeContract,
    ScoringContract,
)
from tests.waiting import PATIENCE

#: Offer, method of the plugin, and first test of each contract.
KINDS = {
    ProbeContract: (ProbeOffer, "read", "test_reads_each_resource_once"),
    ScoringContract: (ScoringOffer, "score", "test_is_pure"),
    MigrationContract: (MigrationOffer, "propose", "test_can_be_undone_before_the_commit"),
    CheckpointContract: (CheckpointOffer, "choose", "test_chooses_hosts_that_are_there"),
}


@dataclass(frozen=True)
class _Options:
    pause: PositiveSeconds = 2.0
    room: Bytes = 0


def contract_of(kind, thing, **fields):
    """Return the contract of an offer that creates one plugin object."""
    contract = kind()
    contract.offer = KINDS[kind][0]("a", lambda *_: thing, **fields)
    return contract


def thing_of(kind, answer):
    """Return a plugin whose main method is a function without arguments."""
    thing = FakeProbe(a=0.5) if kind is ProbeContract else SimpleNamespace()
    setattr(thing, KINDS[kind][1], lambda *_: answer())
    return thing


def run_first(contract):
    getattr(contract, KINDS[type(contract)][2])()


@pytest.mark.parametrize("kind", KINDS)
def test_an_answer_of_another_type_is_named(kind):
    """The message names the type of the answer, not an attribute that the answer lacks."""
    contract = contract_of(kind, thing_of(kind, lambda: 5))
    with pytest.raises(AssertionError, match=r"answered a int; [\w ]+ is required"):
        run_first(contract)


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_without_its_method_is_named(kind):
    """The message names the missing method, as `rosrm config check` does."""
    with pytest.raises(AssertionError, match=r"made None; an object with .* is required"):
        run_first(contract_of(kind, None))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stubborn", [False, True])
def test_a_call_that_takes_too_long_is_ended_and_named(kind, stubborn, monkeypatch):
    """The contract ends the call even where the plugin catches the exception that ends it."""
    monkeypatch.setattr(f"{kind.__module__}.CALL_LIMIT", 0.05, raising=False)

    def hang():
        try:
            time.sleep(30.0)
        except TimeoutError:
            if not stubborn:
                raise

    fields = {"deadline": 0.05} if kind is ProbeContract else {}
    contract = contract_of(kind, thing_of(kind, hang), **fields)
    with pytest.raises(AssertionError, match=rf"^{KINDS[kind][1]} took longer than 0\.05 s"):
        run_first(contract)


def test_an_executor_that_hangs_is_ended_after_the_timeout_of_its_step(tmp_path):
    """The remaining tests run, and the message names the executor."""
    plan = Plan((Execute("a.wait", "a", {}, 0.05),))
    contract = contract_of(
        MigrationContract, SimpleNamespace(propose=lambda move: plan),
        executors={"a.wait": lambda _: time.sleep(30.0)},
    )  # fmt: skip
    with pytest.raises(AssertionError, match=r"executor 'a\.wait' took longer than 0\.05 s"):
        contract.test_executors_answer_with_json_objects(tmp_path)


def test_a_plan_without_a_commit_is_named():
    """`test_plan_is_sound` reports the missing commit; the other tests look at all steps."""

    def propose(move):
        return Plan((Start(move.destination, move.destination_host, 5.0),))

    contract = contract_of(MigrationContract, SimpleNamespace(propose=propose))
    with pytest.raises(AssertionError, match="unsound: it has 0 commit points"):
        contract.test_plan_is_sound()
    with pytest.raises(AssertionError, match="no way back"):
        contract.test_can_be_undone_before_the_commit()


def test_a_score_of_nan_is_named_with_its_host():
    """Each test of the contract names the host whose score is NaN."""
    policy = SimpleNamespace(score=lambda hosts, process: Scores(hosts.usage[:, -1] * 1.0))
    with pytest.raises(AssertionError, match=r"score: the score of host h\d+ is nan"):
        contract_of(ScoringContract, policy).test_is_pure()


@pytest.mark.parametrize("usage", [64.5, 914.0, -0.1])
def test_a_usage_that_the_slave_refuses_fails_the_contract(usage):
    """The contract and the slave use the same check for usage values."""
    contract = contract_of(ProbeContract, FakeProbe(a=usage))
    with pytest.raises(AssertionError, match=r"read: usage .* of 'a'; a fraction of"):
        contract.test_reads_each_resource_once()


@pytest.mark.parametrize("kind", KINDS)
def test_options_of_a_contract_are_written_as_in_a_file(kind):
    """The contract parses values with units, and an unknown option fails with its name."""
    seen = []
    contract = contract_of(kind, None, options=_Options)
    made = thing_of(kind, CheckpointChoice)
    contract.offer = type(contract.offer)(
        "a", lambda options, *context: seen.append(options) or made, _Options
    )
    contract.options = {"pause": "100ms", "room": "2GiB"}
    contract.make()
    assert seen == [_Options(0.1, 2 << 30)]
    contract.options = {"pauze": 1}
    with pytest.raises(AssertionError, match=r"^options: unknown key 'pauze'.*Allowed: pause"):
        contract.make()


@pytest.mark.parametrize("kind", KINDS)
def test_a_contract_is_skipped_where_the_plugin_is_absent(kind):
    """The skip message contains the plugin's reason."""

    def absent(options, *context):
        raise SkipPlugin("no sensor")

    contract = kind()
    contract.offer = KINDS[kind][0]("a", absent)
    with pytest.raises(SkipTest, match="a is absent here: no sensor"):
        contract.make()


def test_the_alarm_of_a_test_runner_stays_set():
    """The limits of the calls restore the process's only interval timer."""
    heard = []
    before = signal.signal(signal.SIGALRM, lambda *_: heard.append(True))
    left, _ = signal.setitimer(signal.ITIMER_REAL, 0.2)
    try:
        contract_of(ProbeContract, FakeProbe(a=0.5)).test_reads_each_resource_once()
        end = time.monotonic() + PATIENCE
        while not heard:
            assert time.monotonic() < end
            time.sleep(0.01)
    finally:
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, left)
