"""Every shipped migration strategy holds the contract that a third party's holds."""

from dataclasses import replace

import pytest

from rosrm.core.migration import AwaitReady, Commit, Execute, Plan, Start, Stop
from rosrm.ports import MigrationOffer
from rosrm.testing import MigrationContract
from rosrm_migration import plugin

OFFERS = {offer.name: offer for offer in plugin.register_migration_strategies()}


class TestRelaunch(MigrationContract):
    offer = OFFERS["relaunch"]


def test_each_shipped_strategy_is_here():
    """A strategy that is added to the plugin must be added here."""
    held = {contract.offer.name for contract in MigrationContract.__subclasses__()}
    assert set(OFFERS) <= held


def _sound(move):
    """Start there, wait, stop here: each with its way back."""
    source = Stop(move.source, move.source_host, 10.0)
    return Plan(
        (
            Start(
                move.destination,
                move.destination_host,
                10.0,
                undo=Stop(move.destination, move.destination_host, 10.0),
            ),
            AwaitReady(move.destination, move.destination_host, 30.0),
            Commit(),
            source,
        ),
        overlap=20.0,
    )


def _changed(**change):
    """The sound plan with one of its steps changed."""

    def propose(move):
        plan = _sound(move)
        return replace(plan, steps=(replace(plan.steps[0], **change), *plan.steps[1:]))

    return propose


@pytest.mark.parametrize(
    ("propose", "test"),
    [
        (lambda move: replace(_sound(move), steps=_sound(move).steps[:2]), "test_plan_is_sound"),
        (_changed(timeout=0.0), "test_plan_is_sound"),
        (_changed(host="elsewhere"), "test_plan_is_sound"),
        (_changed(undo=None), "test_can_be_undone_before_the_commit"),
        (lambda move: replace(_sound(move), overlap=0.0), "test_an_overlap_is_declared"),
        (_sound, "test_an_overlap_is_declared"),  # it overlaps though the process may not
        (
            lambda move: Plan((Execute("unknown", "a", {}, 1.0), Commit())),
            "test_executors_are_its_own",
        ),
    ],
)
def test_contract_catches(propose, test):
    """A strategy that breaks the contract fails the test of that clause."""
    contract = MigrationContract()
    strategy = type("Strategy", (), {"propose": staticmethod(propose)})
    contract.offer = MigrationOffer("bad", lambda options: strategy())
    with pytest.raises(AssertionError):
        getattr(contract, test)()
