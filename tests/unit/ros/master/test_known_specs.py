"""Specs of earlier requests, which a client names by their digest."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from rosrm.model.ledger import BOUNDS, Amount, Store
from rosrm.model.requester import Requester
from rosrm.model.values import ProcessSpec
from rosrm.ros.master.known_specs import KnownSpecs
from rosrm.ros.spec_digests import digest_of, positions_from_text, positions_to_text

ADA = Requester("user:ada")
SPECS = (ProcessSpec("p", command=("run",), parameters={"b": 1, "a": [0.5]}),)


def test_the_digest_covers_each_field() -> None:
    """Equal specs have one digest, whatever the order of their mappings; others have another."""
    same = (replace(SPECS[0], parameters={"a": [0.5], "b": 1}),)
    assert digest_of(same) == digest_of(SPECS)
    assert digest_of((replace(SPECS[0], given=("command",)),)) != digest_of(SPECS)


def test_a_user_finds_only_what_this_user_has_sent() -> None:
    """Otherwise a user could give others a digest of specs that they did not write."""
    known, digests = KnownSpecs(), [digest_of(SPECS[0])]
    known.keep(ADA, digests, SPECS)
    assert known.lacking("user:ada", digests) == []
    assert known.completed("user:ada", digests, ()) == SPECS
    assert known.lacking("user:bob", digests) == [0]


def test_only_the_specs_that_are_not_known_are_sent() -> None:
    """They fill the places of the digests that the master lacks; a client may also send all."""
    known, digests = KnownSpecs(), [f"{number:064}" for number in range(3)]
    one, two, three = (ProcessSpec(name, command=("run",)) for name in ("one", "two", "three"))
    known.keep(ADA, digests[1:2], [two])
    assert known.lacking("user:ada", digests) == [0, 2]
    assert known.completed("user:ada", digests, [one, three]) == (one, two, three)
    assert known.completed("user:ada", digests, [three, two, one]) == (three, two, one)


def test_few_specs_are_kept_the_last_used_ones(monkeypatch) -> None:
    """The memory of the master is bounded, whatever its users send."""
    monkeypatch.setitem(BOUNDS, Store.KNOWN_SPECS, (Amount(8, 2**20), Amount(8, 2**20)))
    known, digests = KnownSpecs(), [f"{number:064}" for number in range(9)]
    for digest in (*digests[:8], digests[0], digests[8]):
        known.keep(ADA, [digest], SPECS)
    assert known.lacking("user:ada", digests) == [1]
    known.keep(ADA, ["x" * 10_000], SPECS)  # is no digest
    assert known.lacking("user:ada", ["x" * 10_000]) == [0]


def test_large_specs_of_a_user_take_no_place_of_others() -> None:
    """The known specs of each user are bounded in bytes."""
    known, digests = KnownSpecs(), [f"{number:064}" for number in range(50)]
    bob = Requester("user:bob")
    known.keep(bob, digests[:1], SPECS)
    for digest in digests:
        known.keep(ADA, [digest], [ProcessSpec("large", command=("x" * 2**20,))])
    assert len(known.lacking("user:ada", digests)) == 50 - 15
    assert known.lacking("user:bob", digests[:1]) == []


@given(st.lists(st.lists(st.integers(0, 9999), max_size=5), max_size=4))
def test_positions_survive_the_message(lacking: list[list[int]]) -> None:
    """A client sends the specs at these positions."""
    assert positions_from_text(positions_to_text(lacking), [10_000] * len(lacking)) == lacking


def test_positions_of_a_text_that_is_none_are_left_out() -> None:
    """A master of another version may send a sentence; the client then sends all specs."""
    assert positions_from_text("send 3 processes; now", [3, 3, 3]) == [[], [], []]
