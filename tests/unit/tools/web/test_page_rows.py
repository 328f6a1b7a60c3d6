"""Rows of the page's tables, and what is wrong, from a listing."""

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from rosrm.model.rows import DeviceRow, HostRow, Listing, ProcessRow, ResourceRow
from rosrm.model.values import HostDescription
from rosrm_web.page.rows import changed, host_rows, problems, process_row

TABLES = st.dictionaries(st.sampled_from("abcdef"), st.integers(0, 3))


def host(name: str, state: str = "up", **fields) -> HostRow:
    memory = ResourceRow("memory", "B", 1e9, "machine", 0.5, 0.0, 0.8, stale=False)
    described = HostDescription(name, 1, labels={"room": "1"})
    return HostRow(described, 1, state, False, False, True, 0.1, (memory,), 2, **fields)


def process(name: str, state: str = "running", **fields) -> ProcessRow:
    row = ProcessRow(name, "service", state, "h", 1, 7, 0, 0, None, 0, 0, 1.0, 0.25, 2_000_000, "")
    return replace(row, **fields)


@given(TABLES, TABLES)
def test_a_transaction_makes_one_table_the_other(before, after):
    """And holds no row that is as it was."""
    before, after = (
        {key: {"id": key, "value": value} for key, value in one.items()} for one in (before, after)
    )

    change = changed(before, after)

    made = {key: row for key, row in before.items() if {"id": key} not in change.remove}
    made |= {row["id"]: row for row in (*change.add, *change.update)}
    assert made == after
    assert not any(before.get(row["id"]) == row for row in (*change.add, *change.update))


def test_a_host_shows_usage_limit_and_marks():
    """The share and the limit are for the bar; the text is for everyone."""
    row = host_rows([replace(host("h"), cordoned=True)])["h"]

    assert (row["state"], row["memory"], row["labels"]) == (
        "up, cordoned",
        "50 % of 80 %",
        "room=1",
    )
    assert (row["memory_share"], row["memory_limit"]) == (0.5, 0.8)


def test_a_host_shows_its_devices():
    """The cell has the same text as `rosrm hosts`."""
    devices = (DeviceRow("camera", "front", holders=("slam#12",)), DeviceRow("gpu", "0", free=1.0))

    assert host_rows([host("h", devices=devices)])["h"]["devices"] == "camera 0/1, gpu 1/1"


def test_a_process_shows_why_it_is_not_well_in_one_line():
    """Further lines of a reason are in its dialog."""
    row = process_row(process("p", "failed", reason="exit code 4\ndetails"))

    assert (row["state"], row["why"], row["memory"]) == ("failed", "exit code 4", "2.0 MB")


def test_problems_are_counted_by_state_hosts_first():
    """Hosts and processes that are well are not listed as problems."""
    hosts = [host("a"), host("b", "lost"), host("c", "lost")]
    processes = [process("p", "failed"), process("q"), process("r", "set_aside")]

    found = problems(Listing("m", 1.0, 1, hosts=hosts, processes=processes))

    assert [one.text for one in found] == [
        "2 hosts lost", "1 process failed", "1 process set aside"
    ]  # fmt: skip
