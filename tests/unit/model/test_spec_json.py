"""A process spec as JSON, for the journal."""

from __future__ import annotations

import json

import pytest
from hypothesis import given

from rosrm.model.codec import from_plain, to_plain
from rosrm.model.values import ProcessSpec
from tests.drawing import SPECS


@given(SPECS)
def test_a_spec_comes_back_from_json_as_it_was(spec):
    assert from_plain(ProcessSpec, json.loads(json.dumps(to_plain(spec)))) == spec


def test_an_older_record_gets_the_defaults_of_what_it_lacks():
    assert from_plain(ProcessSpec, {"name": "a"}) == ProcessSpec("a")


def test_a_field_of_a_newer_version_is_refused_not_dropped():
    with pytest.raises(ValueError, match=r"^unknown colour; allowed: name, "):
        from_plain(ProcessSpec, {"name": "a", "colour": 1})
    with pytest.raises(ValueError, match=r"^restart: unknown colour; allowed: when, "):
        from_plain(ProcessSpec, {"name": "a", "restart": {"colour": 1}})
