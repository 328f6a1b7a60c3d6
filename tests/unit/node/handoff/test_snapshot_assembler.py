"""Assembly of snapshots from marks and parts: a cut is consistent or dropped."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.node.handoff import snapshot_assembler
from rosrm.node.handoff.snapshot_assembler import CutAssembler, part_key
from tests.cpp.core_parts import CppCutAssembler

A, B = "/a", "/b"


def mark(sequence, stamps=(), **parts):
    described = [
        SimpleNamespace(topic=f"/{name}", size=part_key(data).size, digest=part_key(data).digest)
        for name, data in parts.items()
    ]
    return SimpleNamespace(
        sequence=sequence, parts=described, outputs=(), timers_due=(),
        inputs=[SimpleNamespace(topic="/in", covered=stamps)],
    )  # fmt: skip


class PyCutAssembler(CutAssembler):
    """`CutAssembler` with a method for tests."""

    def stored(self, topic: str) -> int:
        return len(self._at_hand[topic])


def python_cuts(most_bytes: int, most_marks: int, most_entries: int) -> PyCutAssembler:
    snapshot_assembler._MOST_BYTES = most_bytes
    snapshot_assembler._MOST_MARKS = most_marks
    snapshot_assembler._MOST_ENTRIES = most_entries
    return PyCutAssembler()


@pytest.fixture(scope="module", params=["Python", "C++"])
def make(request):
    """Return each implementation, of `rosrm.node` and of `rosrm_node_cpp`, as a function."""
    if request.param == "C++":
        yield partial(CppCutAssembler, request.getfixturevalue("cpp_core"))
        return
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_MOST_BYTES", "_MOST_MARKS", "_MOST_ENTRIES"):
            patch.setattr(snapshot_assembler, name, getattr(snapshot_assembler, name))
        yield python_cuts


def assembler(make, *topics, most_bytes=1 << 30, most_marks=20_000, most_entries=50_000_000):
    cuts = make(most_bytes, most_marks, most_entries)
    for topic in topics:
        cuts.expect(topic)
    return cuts


def test_a_state_is_complete_with_its_mark_and_all_parts(make):
    """Mark and parts may arrive in any order."""
    cuts = assembler(make, A, B)
    cuts.add_part(A, b"a1")
    cuts.add_mark(mark(1, a=b"a1", b=b"b1"), 7.0)
    assert (cuts.take(), cuts.missing()) == (None, [B])
    cuts.add_part(B, b"b1")
    cut = cuts.take()
    assert (cut.mark.sequence, dict(cut.parts), cut.arrived) == (1, {A: b"a1", B: b"b1"}, 7.0)
    assert cuts.take() is None


def test_parts_of_different_cycles_are_never_mixed(make):
    """A mark whose part was lost waits for the next."""
    cuts = assembler(make, A, B)
    cuts.add_part(A, b"a1")
    cuts.add_part(B, b"b2")
    cuts.add_mark(mark(1, a=b"a1", b=b"b1"), 0.0)
    assert cuts.take() is None
    cuts.add_mark(mark(2, a=b"a1", b=b"b2"), 0.0)
    assert cuts.take().mark.sequence == 2


def test_no_more_is_kept_than_the_state_in_use_and_what_may_come(make):
    """A snapshot of megabytes in every cycle would fill the memory."""
    cuts = assembler(make, A)
    for sequence in range(100):
        cuts.add_part(A, b"%d" % sequence)
        cuts.add_mark(mark(sequence, a=b"%d" % sequence), 0.0)
        cuts.take()
    assert cuts.stored(A) == 1
    assert cuts.take() is None


@given(st.data())
def test_any_order_of_arrival_ends_at_the_last_state(make, data):
    """Each single topic is in order; a part is sent when it changes, and may recur."""
    part = st.sampled_from([b"x", b"y"])
    states = data.draw(st.lists(st.tuples(part, part), min_size=1))
    queues = {A: [], B: [], "mark": []}
    before = (None, None)
    for sequence, (a, b) in enumerate(states):
        if a != before[0]:
            queues[A].append(a)
        if b != before[1]:
            queues[B].append(b)
        queues["mark"].append(mark(sequence, a=a, b=b))
        before = (a, b)
    cuts = assembler(make, A, B)
    taken = []
    while any(queues.values()):
        name = data.draw(st.sampled_from([name for name, queue in queues.items() if queue]))
        item = queues[name].pop(0)
        cuts.add_mark(item, 0.0) if name == "mark" else cuts.add_part(name, item)
        cut = cuts.take()
        if cut is not None:
            taken.append(cut)
    assert [cut.mark.sequence for cut in taken] == sorted({cut.mark.sequence for cut in taken})
    for cut in taken:
        assert (cut.parts[A], cut.parts[B]) == states[cut.mark.sequence]
    assert taken[-1].mark.sequence == len(states) - 1


def test_the_bytes_of_parts_are_bounded(make):
    """Marks that name many parts of one topic, and of another one that never comes, keep all."""
    cuts = assembler(make, A, B, most_bytes=100)
    for sequence in range(50):
        data = b"%02d" % sequence * 10
        cuts.add_mark(mark(sequence, a=data, b=b"never"), 0.0)
        cuts.add_part(A, data)
        assert cuts.stored(A) <= 100 // len(data)
    cuts.add_part(B, b"never")
    assert cuts.take().mark.sequence == 49


@pytest.mark.parametrize("stamps", [(), range(100)])
def test_the_marks_that_wait_are_bounded(make, stamps):
    """The destination then fails the handoff; marks whose states came do not count."""
    cuts = assembler(make, A, most_marks=50, most_entries=3000)
    cuts.add_part(A, b"here")
    for sequence in range(200):
        assert cuts.add_mark(mark(sequence, stamps, a=b"here"), 0.0)
        assert cuts.take() is not None
    waiting = [cuts.add_mark(mark(200 + one, stamps, a=b"never"), 0.0) for one in range(60)]
    assert waiting.index(False) == (29 if stamps else 50)
