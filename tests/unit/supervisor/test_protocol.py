"""Supervisor protocol: round trip of orders, and refusal of anything else."""

from __future__ import annotations

import hypothesis.strategies as st
import pytest
from hypothesis import given

from rosrm.core.supervisor.events import (
    ContactReported,
    FailOrdered,
    FenceOrdered,
    RestartOrdered,
    ShutdownOrdered,
    StatusStored,
    StopOrdered,
)
from rosrm.core.supervisor.rules import (
    AdoptionRule,
    FenceRule,
    LimitRule,
    RestartRule,
    RunLimits,
    StopRule,
)
from rosrm.model.durations import LONGEST_STOP
from rosrm.supervisor import json_lines as ls
from rosrm.supervisor import messages
from rosrm.supervisor.logs import LogLimits

SECONDS = st.floats(0, 1e6)
GRACE = st.floats(0, LONGEST_STOP / 2)
WHOLE = st.integers(-(2**63), 2**63)
KEYS = st.tuples(st.text(), st.integers(0, 2**53))
# Arguments as Linux passes them: any bytes; invalid UTF-8 becomes surrogates.
WORDS = st.binary().map(lambda data: data.decode("utf-8", "surrogateescape"))
RULES = st.builds(
    RestartRule,
    st.sampled_from(["never", "on-failure", "always"]),
    SECONDS,
    SECONDS,
    SECONDS,
    st.integers(0, 99),
    SECONDS,
)
RUN_LIMITS = st.builds(RunLimits, *[SECONDS] * 3, st.booleans())
LIMITS = st.builds(
    LimitRule,
    *[SECONDS] * 3,
    st.lists(st.integers(0, 65_535), max_size=3).map(tuple),
    st.sampled_from(["", "fifo", "rr"]),
    st.integers(0, 99),
    st.integers(-20, 19),
    st.booleans(),
)
ADOPTIONS = st.builds(AdoptionRule, st.integers(2, 2**31 - 1), st.integers(0, 2**53), st.text())
CHANGES = st.dictionaries(WORDS, st.none() | WORDS)
ORDERS = st.one_of(
    st.builds(messages.Hello, WHOLE, WHOLE, st.just(LogLimits(1, 2, 3, 4, 5))),
    st.builds(messages.Environment, st.text(), st.dictionaries(WORDS, WORDS)),
    st.builds(
        messages.Launch,
        KEYS,
        st.lists(WORDS, min_size=1).map(tuple),
        st.text(),
        CHANGES,
        st.none() | WORDS,
        RULES,
        st.builds(StopRule, GRACE, GRACE),
        st.text(),
        st.none() | st.builds(FenceRule, SECONDS, SECONDS, st.booleans()),
        SECONDS,
        LIMITS,
        st.dictionaries(WORDS, WORDS),
        st.none() | ADOPTIONS,
        st.integers(0, 2**32),
        st.lists(WORDS).map(tuple),
        st.dictionaries(WORDS, WORDS),
    ),
    st.builds(StopOrdered, KEYS),
    st.builds(FenceOrdered, KEYS),
    st.builds(ContactReported, SECONDS, SECONDS),
    st.builds(RestartOrdered, KEYS, st.none() | st.tuples(st.integers(0, 99), st.integers(0, 99))),
    st.builds(FailOrdered, KEYS, st.integers(1, 2**31), st.text(), st.booleans()),
    st.builds(messages.Amend, KEYS, RULES, CHANGES, st.none() | RUN_LIMITS),
    st.builds(messages.Remember, KEYS, st.text()),
    st.builds(messages.Forget, st.lists(st.builds(StatusStored, KEYS)).map(tuple)),
    st.just(ShutdownOrdered()),
)


@given(ORDERS)
def test_orders_survive_the_way(order):
    """Each order reads back from one line as an equal object of the same type."""
    line = messages.encode_order(order)
    assert line.count(b"\n") == 1
    read = messages.decode_order(line)
    assert read == order
    assert type(read) is type(order)


@given(st.lists(st.binary().map(lambda data: data.replace(b"\n", b"")), max_size=5), st.data())
def test_lines_are_cut_wherever_the_stream_is(lines, data):
    """The lines do not depend on the sizes of the received parts."""
    stream = b"".join(line + b"\n" for line in lines)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    cutter, found = ls.LineSplitter(), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += cutter.feed(stream[begin:end])
    assert found == lines


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"hello", "not a line of JSON"),
        (b"[1]", "not a JSON object"),
        (b'{"do": "dance"}', "unknown order 'dance'; known: hello,"),
        (b'{"do": "stop"}', "'stop' cannot be read: KeyError"),
        (b'{"do": "stop", "instance": ["a"]}', "'stop' cannot be read: ValueError"),
        (b'{"do": "stop", "instance": [1, 2]}', "'stop' cannot be read: TypeError"),
        (
            b'{"do": "amend", "instance": ["a", 1], "restart": ["maybe", 1, 1, 1, 1, 1]}',
            "'amend' cannot be read: ValueError",
        ),
        (b'{"do": ["stop"]}', "unknown order"),
        (b'{"do": "environment", "id": "e", "variables": null}', "read: AttributeError"),
        (b'{"do": "hello", "protocol": 1e999, "pid": 1, "log": []}', "is not a whole number"),
        (b"[" * 100_000, "not a line of JSON"),
    ],
)
def test_what_is_not_understood_is_refused(line, said):
    """The refusal names the error; nothing is guessed."""
    with pytest.raises(ls.ProtocolError, match=said):
        messages.decode_order(line)


def test_a_line_without_end_is_refused():
    """A peer cannot fill the memory."""
    with pytest.raises(ls.ProtocolError, match="longer than"):
        ls.LineSplitter().feed(b"x" * (ls.LONGEST_LINE + 1))
