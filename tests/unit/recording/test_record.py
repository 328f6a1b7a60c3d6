"""Record of a run: written data reads back, and anything else is refused."""

from __future__ import annotations

import dataclasses
import struct
import zlib
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rosrm.core.master import events as happened
from rosrm.errors import RecordError
from rosrm.model.values import RESOURCE_SLOTS
from rosrm.recording.encoding import decode, encode
from tests.drawing import drawn
from tests.unit.tools.simulate.workloads import host, plan, read, recorded, simulation

INT = st.integers(0, 2**53)
FLOAT = st.floats(allow_nan=False)
#: Events that are arrays and not JSON in a record.
OF_ARRAYS = (happened.ReadingsReceived, happened.UsagesReceived)


@st.composite
def readings(draw):
    count = draw(st.integers(0, 4))

    def column(kind, **options):
        return draw(arrays(kind, count, **options))

    def slots():
        used = draw(st.integers(0, RESOURCE_SLOTS))
        whole = np.full((count, RESOURCE_SLOTS), draw(FLOAT))
        whole[:, :used] = draw(arrays(np.float64, (count, used)))
        return whole

    return happened.ReadingsReceived(
        column(np.int64), column(np.uint64), column(np.uint64), column(np.uint64),
        column(np.bool_), column(np.uint32), slots(), slots(),
    )  # fmt: skip


@st.composite
def usages(draw):
    count = draw(st.integers(0, 4))
    numbers = draw(arrays(np.uint64, count))
    amounts = arrays(np.float64, count)
    others = draw(st.dictionaries(st.integers(0, RESOURCE_SLOTS - 1), amounts, max_size=2))
    return happened.UsagesReceived(
        draw(INT), draw(INT), numbers, draw(amounts), draw(amounts), others
    )


EVENTS = st.one_of(
    readings(),
    usages(),
    *(drawn(kind) for kind in get_args(happened.Event) if kind not in OF_ARRAYS),
)


def same(one, other) -> bool:
    """Return True if both are equal bit by bit: NaN equals NaN, and 0.0 is not -0.0."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and (
            one.tobytes() == other.tobytes()
        )  # fmt: skip
    return one == other


@given(event=EVENTS, now=FLOAT, wall=FLOAT)
def test_an_event_comes_back_as_it_was(event, now, wall):
    back = decode(*encode(event, now, wall))
    assert (back.now, back.wall) == (now, wall)
    assert type(back.event) is type(event)
    for field in dataclasses.fields(event):
        assert same(getattr(event, field.name), getattr(back.event, field.name)), field.name


@pytest.mark.parametrize(
    ("number", "order_id"),
    [
        (7, 7),
        ((1 << 40) + 1, ("replication", 1)),
        ((1 << 41) + 3, ("capability", 3)),
        ((1 << 42) + 2, ("periodic", 2)),
    ],
)
def test_an_answer_of_an_older_record_belongs_to_the_same_order(number, order_id):
    """Rosrm 0.1.0 wrote the orders that depend on optional plugins with large numbers."""
    kind, content = encode(happened.OrderAnswered(number, accepted=True), 1.0, 2.0)
    assert decode(kind, content).event == happened.OrderAnswered(order_id, accepted=True)


@pytest.fixture(scope="module")
def content() -> bytes:
    plans = [plan(f"p{n}", at=0.2 * n, duration=1.0) for n in range(3)]
    return recorded(simulation([host("a"), host("b")], plans, until=2.5))


def test_a_record_is_read_as_it_was_written(content):
    record = read(content)
    assert record.header.master == "test"
    assert record.end == "stopped"
    assert sum(one.decided is not None for one in record.events) >= 3
    assert any(isinstance(one.event, happened.UsagesReceived) for one in record.events)


def test_cut_anywhere_it_is_refused_and_says_where(content):
    """The cut is at every byte of the first and the last frames, and at some between."""
    cuts = {*range(1, 200), *range(len(content) - 200, len(content)), *range(0, len(content), 97)}
    for end in sorted(cuts - {0}):
        with pytest.raises(RecordError) as raised:
            read(content[:end])
        if end >= len(b"rosrm-record "):
            assert "cut short at byte" in str(raised.value), end


def test_what_is_there_of_one_that_was_cut_can_be_used(content):
    whole, record = read(content), read(content[:-300], cut=True)
    assert record.end == "cut short"
    assert 0 < len(record.events) < len(whole.events)
    assert [one.now for one in record.events] == [
        one.now for one in whole.events[: len(record.events)]
    ]


@pytest.mark.parametrize("at", [30, 2050, -3])
def test_a_flipped_bit_is_noticed_also_where_a_cut_would_be_borne(content, at):
    broken = bytearray(content)
    broken[at] ^= 4
    with pytest.raises(RecordError, match="damaged at byte"):
        read(bytes(broken), cut=True)


def test_zeros_behind_the_last_whole_frame_are_a_cut(content):
    """A power loss leaves them at any byte: within a frame, within its length, between two."""
    whole = read(content)
    for end in {*range(1800, 2600), len(content) - 17, len(content) - 16, len(content) - 3}:
        torn = content[:end].rstrip(b"\0") + bytes(5000)
        with pytest.raises(RecordError, match="cut short at byte"):
            read(torn)
        record = read(torn, cut=True)
        assert record.end == "cut short"
        assert [one.now for one in record.events] == [
            one.now for one in whole.events[: len(record.events)]
        ]
        assert len(record.events) >= len(read(content[:end], cut=True).events)


@pytest.mark.parametrize(
    ("end", "zeros", "at"),
    [(40, 0, 15), (13, 5000, "(0|15)"), (14, 5000, "(0|15)"), (15, 5000, "(0|15)"),
     (40, 5000, "(0|15)")],
)  # fmt: skip
def test_a_cut_or_zeros_in_the_header_leave_nothing_to_use(content, end, zeros, at):
    with pytest.raises(RecordError, match=f"cut short at byte {at}"):
        read(content[:end] + bytes(zeros), cut=True)


def test_zeros_with_anything_behind_them_are_damage(content):
    torn = content[:2000] + bytes(5000)
    with pytest.raises(RecordError, match="damaged at byte"):
        read(torn + content[7000:], cut=True)


@pytest.mark.parametrize("foreign", [b"", b"hosts: []\n", b"\x7fELF" * 100, b"rosrm-reco"])
def test_another_file_is_no_record(foreign):
    with pytest.raises(RecordError, match=r"r\.rosrec: is no recording of a master's run"):
        read(foreign)


@pytest.mark.parametrize("version", [b"2", b"0", b"x"])
def test_another_version_is_refused_and_both_are_named(content, version):
    newer = content.replace(b"rosrm-record 1\n", b"rosrm-record " + version + b"\n", 1)
    with pytest.raises(RecordError) as raised:
        read(newer)
    assert f"is a recording of version {version.decode()}; this rosrm reads" in str(raised.value)


def framed(body: bytes) -> bytes:
    return struct.pack("<II", len(body), zlib.crc32(body)) + body


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"H{}", "is not allowed there"),
        (b"E" + bytes(16) + b'{"kind":"Unheard"}', "KeyError"),
        (b"E" + bytes(16) + b"no json", "is invalid for"),
        pytest.param(b"E" + bytes(16) + b"[" * 100_000, "is invalid for", id="deep"),
        (b"E" + bytes(16) + b'{"kind":"HostLeft","request":1}', "is missing"),
        (b"R" + bytes(16) + b"\xff\xff", "is invalid for"),
        (b"E" + struct.pack("<dd", -5.0, 0.0) + b'{"kind":"TimePassed"}', "its time is before"),
        (b"D{}", "a list of decisions"),
    ],
)
def test_a_whole_frame_that_makes_no_sense_is_refused_with_its_place(content, body, said):
    end = framed(b"Zstopped")
    assert content.endswith(end)
    with pytest.raises(RecordError, match=said) as raised:
        read(content[: -len(end)] + framed(body) + end)
    assert f"byte {len(content) - len(end)}" in str(raised.value)
