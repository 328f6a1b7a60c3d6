"""Transition tables in the docstrings of master's and slave's reducer match the code."""

from __future__ import annotations

import re
from typing import get_args

import pytest

from rosrm.core.master import events as master_events
from rosrm.core.master import reducer as master
from rosrm.core.slave import events as slave_events
from rosrm.core.slave import reducer as slave


@pytest.mark.parametrize(
    ("reducer", "events"), [(master, master_events), (slave, slave_events)], ids=["master", "slave"]
)
def test_every_event_has_its_row_and_its_handler(reducer, events) -> None:
    """Docstring, handlers and the union of the events name the same kinds, each once."""
    _, _, table, _ = re.split(r"^=+  =+\n?", reducer.__doc__, flags=re.MULTILINE)
    rows = re.findall(r"^(\w+) +\S", table, re.MULTILINE)
    handled = [kind.__name__ for kind in reducer.HANDLERS]
    assert sorted(rows) == sorted(handled)
    assert sorted(handled) == sorted(kind.__name__ for kind in get_args(events.Event))
