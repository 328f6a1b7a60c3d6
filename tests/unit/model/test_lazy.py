"""Lazy mappings: rendered and encoded once, however many rows of the journal contain them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pytest

from rosrm.model.codec import to_json, to_plain
from rosrm.model.lazy import Lazy, Plain, mapping_to_json
from rosrm.model.values import Kind, ProcessSpec, StopPolicy


class Counted(Lazy):
    """A mapping that counts how often it is rendered."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def render(self) -> Mapping[str, Any]:
        self.count += 1
        return {"reason": 'it is "full"', "limits": {"cpu": 0.5}}


@pytest.mark.parametrize("others", [{}, {"number": 3, "devices": []}])
def test_the_text_of_a_lazy_value_is_inserted(others: Mapping[str, Any]) -> None:
    """The JSON of a mapping has the same values, rendered late or not, as only or as one entry."""
    text = mapping_to_json({"decision": Counted(), **others})
    assert json.loads(text) == {"decision": Counted().render(), **others}


def test_a_lazy_value_is_rendered_once() -> None:
    """The rows of the journal, and a reader after them, share one rendering."""
    lazy = Counted()
    assert mapping_to_json({"spec": lazy}) == mapping_to_json({"spec": lazy})
    assert lazy["limits"] == {"cpu": 0.5}
    assert lazy.count == 1


def test_the_text_of_a_spec_is_its_plain_form() -> None:
    """Specs share the text of an equal policy, and differ in the policies of their own."""
    shared = StopPolicy(interrupt_grace=1.5)
    for spec in (
        ProcessSpec("talker", stop=shared, environment={"A": 'with "quotes"'}),
        ProcessSpec("listener", stop=shared, needs={"cpu": 0.5}),
        ProcessSpec("other", stop=StopPolicy(interrupt_grace=2.5), kind=Kind.JOB),
        ProcessSpec("", environment={}, time_limit=float(0)),
    ):
        assert json.loads(Plain(spec).text) == json.loads(to_json(to_plain(spec)))
