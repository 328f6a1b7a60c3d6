"""Traces of starts: stamps in a log, and the table over several starts."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from rosrm.client import start_traces
from rosrm.client.start_traces import STAMPS, hand_overs, stamps_in_log, submit_traced
from rosrm.errors import RosrmError
from rosrm.model.rows import Listing, LogPart, ProcessRow
from rosrm.model.start_trace import LINE, VARIABLE
from rosrm.model.values import ProcessSpec
from tests.unit.cli.conftest import process

SENT = 1_700_000_000_000_000_000
OWN = SENT + 9_000_000
TRACE_LINE = f"{LINE}client_sent={SENT} decided={SENT + 2_000_000} spawned={SENT + 8_000_000}"


@pytest.mark.parametrize("lines", [[str(OWN), TRACE_LINE], [TRACE_LINE, str(OWN), str(OWN + 5)]])
def test_the_log_has_the_stamps_and_that_of_the_process(lines) -> None:
    """The process may write before the supervisor does; its first time counts."""
    stamps = stamps_in_log(["hello", *lines, "12", "rosrm: trace: "])
    assert stamps["process_started"] == OWN
    assert (stamps["client_sent"], stamps["decided"]) == (SENT, SENT + 2_000_000)


def test_a_log_without_a_trace_has_no_stamps() -> None:
    """A process may print times of its own."""
    assert stamps_in_log([str(OWN), "hello"]) == {}


def test_the_stamps_of_a_repeated_delivery_and_foreign_words_do_not_count() -> None:
    """The log belongs to the process, so any text may follow the mark."""
    line = f"{LINE}client_sent={SENT} decided={SENT} decided={OWN} decided sent=1 recorded=-5"
    assert stamps_in_log([line]) == {"client_sent": SENT, "decided": SENT}


def test_the_table_has_medians_of_the_steps_and_of_the_sums() -> None:
    """The median of a step differs from the difference of two medians."""
    traces = [
        {"client_sent": SENT, "master_received": SENT + first, "decided": SENT + first + second}
        for first, second in [
            (1_000_000, 5_000_000),
            (2_000_000, 2_000_000),
            (6_000_000, 1_000_000),
        ]
    ]
    rows = {row.stamp: (row.step_ms, row.since_submit_ms) for row in hand_overs(traces)}
    assert rows["client_sent"] == (None, 0.0)
    assert rows["master_received"] == (2.0, 2.0)
    assert rows["decided"] == (2.0, 6.0)


def test_a_missing_stamp_leaves_cells_empty() -> None:
    """A process without a stamp of its own still has all other rows, in their order."""
    rows = hand_overs([{"client_sent": SENT, "recorded": OWN, "spawned": OWN}])
    assert [row.stamp for row in rows] == [*STAMPS, "spawned", "client_answered"]
    by_stamp = {row.stamp: row for row in rows}
    assert by_stamp["process_started"].since_submit_ms is None
    assert by_stamp["recorded"].step_ms is None
    assert by_stamp["spawned"].since_submit_ms == 9.0


@dataclass
class Master:
    """Fake master of one host, whose processes are in a state, with a log."""

    row: ProcessRow
    log: str = ""
    submitted: list[ProcessSpec] = field(default_factory=list)

    def submit(self, specs) -> str:
        self.submitted += specs
        return "queued"

    def list(self, **_) -> Listing:
        return Listing("m", 1.0, 1, processes=(self.row,))

    def read_log(self, _host, _process, _number, offset, size) -> LogPart:
        sent = self.submitted[0].environment[VARIABLE]
        part = self.log.format(sent=sent).encode()[offset : offset + size]
        return LogPart(1, (1,), part, offset, offset + len(part), False, ())


@pytest.fixture(autouse=True)
def _at_once(monkeypatch) -> None:
    monkeypatch.setattr(start_traces, "_PERIOD", 0.0)
    monkeypatch.setattr(start_traces, "_OWN_STAMP", 0.0)


def traced(master: Master):
    specs = [ProcessSpec("p", command=("x",), environment={"A": "b"})]
    return submit_traced(master, specs, timeout=0.0, notify=print)


def test_a_traced_submission_returns_the_trace_of_this_start() -> None:
    """The other variables of the process stay; the stamps of the client are in the trace."""
    master = Master(process("p"), f"{LINE}{{sent}} decided={OWN}\n")
    trace = traced(master)["p"]
    assert master.submitted[0].environment["A"] == "b"
    assert list(trace) == ["client_sent", "decided", "client_answered"]
    assert trace["client_sent"] <= trace["client_answered"]


def test_a_process_may_write_much_before_its_trace() -> None:
    """The process runs before the supervisor writes the trace to its log."""
    noise = 12_345 * "loading a map\n"
    master = Master(process("p"), f"{noise}{LINE}{{sent}} decided={OWN}\n{noise}{OWN}\n")
    assert traced(master)["p"]["process_started"] == OWN


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (process("p", "failed", reason="no such program"), "of p: it has failed: no such program"),
        (process("p"), "of p: it is running"),
    ],
)
def test_a_start_that_left_no_trace_is_an_error_with_the_state(row, message) -> None:
    """The log has the trace of an earlier instance of the name."""
    with pytest.raises(RosrmError, match=message):
        traced(Master(row, f"{TRACE_LINE}\n"))
