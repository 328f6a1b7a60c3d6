"""Reports of any events: a journal may be damaged, or of another version."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow
from rosrm_report.extract import report_of
from rosrm_report.model import Material
from rosrm_report.page import page_of
from tests.unit.tools.report.test_page import Page

_NUMBERS = st.integers(-5, 5) | st.floats()
_PLAIN = st.recursive(
    st.none() | st.text(max_size=3) | _NUMBERS | st.just("a"),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=3,
)
_SCORES = st.fixed_dictionaries({"name": st.sampled_from("abc"), "score": _PLAIN})
_FACTS = st.fixed_dictionaries(
    {},
    optional={
        "number": _PLAIN, "destination": _PLAIN, "from": _PLAIN, "to": _PLAIN, "cause": _PLAIN,
        "seconds": _PLAIN, "resource": _PLAIN,
        "decision": _PLAIN | st.fixed_dictionaries({"hosts": _PLAIN | st.lists(_SCORES)}),
    },
)  # fmt: skip
_EVENTS = st.builds(
    EventRow, st.integers(0, 50), st.floats(0, 2e9) | st.floats(), st.floats(0, 100) | st.floats(),
    st.sampled_from([*(one.value for one in EventKind), "of_the_future"]),
    st.sampled_from(["", "p", "q<"]), st.sampled_from(["", "a", "b&"]), st.text(max_size=9), _FACTS,
)  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(st.lists(_EVENTS, max_size=30))
def test_any_events_have_a_page(events):
    """The times of the report ascend, and the queue is never negative."""
    made = report_of(Material("any", events))
    Page(page_of(made))

    assert all(one.begin <= one.end <= made.length for one in [*made.placements, *made.waits])
    assert all(length >= 0 for _, length in made.queue)
