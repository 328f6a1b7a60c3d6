"""Specs of earlier requests, which a client names by their digest."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.errors import Refused
from rosrm.model.values import ProcessSpec
from rosrm.ros.master.known_specs import KnownSpecs
from rosrm.ros.spec_digests import UNKNOWN_DIGEST, digest_of

SPECS = (ProcessSpec("p", command=("run",), parameters={"b": 1, "a": [0.5]}),)


def test_the_digest_covers_each_field() -> None:
    """Equal specs have one digest, whatever the order of their mappings; others have another."""
    same = (replace(SPECS[0], parameters={"a": [0.5], "b": 1}),)
    assert digest_of(same) == digest_of(SPECS)
    assert digest_of((replace(SPECS[0], given=("command",)),)) != digest_of(SPECS)


def test_a_user_finds_only_what_this_user_has_sent() -> None:
    """Otherwise a user could give others a digest of specs that they did not write."""
    known, digest = KnownSpecs(), digest_of(SPECS)
    known.keep("user:ada", digest, SPECS)
    assert known.find("user:ada", digest) == SPECS
    with pytest.raises(Refused, match="send the processes themselves") as refusal:
        known.find("user:bob", digest)
    assert refusal.value.code == UNKNOWN_DIGEST


def test_few_requests_are_kept_the_last_used_ones() -> None:
    """The memory of the master is bounded, whatever its users send."""
    known, digests = KnownSpecs(), [f"{number:064}" for number in range(9)]
    for digest in digests[:8]:
        known.keep("user:ada", digest, SPECS)
    known.find("user:ada", digests[0])
    known.keep("user:ada", digests[8], SPECS)
    assert known.find("user:ada", digests[0]) == SPECS
    with pytest.raises(Refused):
        known.find("user:ada", digests[1])
    known.keep("user:ada", "x" * 10_000, SPECS)  # is no digest
    with pytest.raises(Refused):
        known.find("user:ada", "x" * 10_000)
