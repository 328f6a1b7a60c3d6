"""Tables in docstrings, and the states of listings, match the code of master and slave."""

from __future__ import annotations

import re
from typing import get_args

import pytest

from rosrm.core.master import events as master_events
from rosrm.core.master import reducer as master
from rosrm.core.master.state.process import ProcessPhase
from rosrm.core.slave import events as slave_events
from rosrm.core.slave import reducer as slave
from rosrm.model.rows import PROCESS_STATES


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


def test_a_listing_has_each_phase_of_a_process_as_a_state():
    """Besides "unknown", for a process whose host is silent and not lost yet."""
    assert set(PROCESS_STATES) == {*(phase.value for phase in ProcessPhase), "unknown"}
