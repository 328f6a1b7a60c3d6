"""Rows of a listing fit the bounds of their receivers, so that one row refuses no listing."""

from __future__ import annotations

import json

import pytest

from rosrm.model.rows import EventRow, PluginRow
from rosrm.ros.bounds import check_bounds, fitted
from rosrm.ros.convert import event_from_msg, event_to_msg, plugin_row_to_msg

LONG = "x" * 3_000_000


@pytest.mark.parametrize("text", [LONG, "\ud800", "\ud800" + LONG, "\N{SNOWMAN}"])
def test_a_row_with_any_text_can_be_sent(text: str) -> None:
    """Each text is cut to its bound, and has a UTF-8 form."""
    rows = [
        fitted(plugin_row_to_msg(PluginRow("probe", text[:9], text, "broken", text, text))),
        fitted(event_to_msg(EventRow(1, 0.0, 0.0, "plugin_failed", text, text, text, {}))),
    ]
    for row in rows:
        check_bounds(row)
        for field in row.get_fields_and_field_types():
            value = getattr(row, field)
            assert not isinstance(value, str) or value.encode()


def test_facts_that_are_too_long_are_left_out() -> None:
    """JSON that was cut in the middle would refuse the listing in another way."""
    row = EventRow(1, 0.0, 0.0, "plugin_failed", "", "", "", {"a": LONG})
    message = fitted(event_to_msg(row))
    assert json.loads(message.data) == {"cut": True}
    assert event_from_msg(message).facts == {"cut": True}
