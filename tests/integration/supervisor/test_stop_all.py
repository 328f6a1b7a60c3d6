"""`rosrm slave --stop-all`: what a slave that is gone left running on its host is ended."""

from __future__ import annotations

import pytest

from rosrm.errors import Refused, RosrmError
from rosrm.slave.stop_all import stop_all
from rosrm.state_directory import only_one

from .conftest import Host, wait_gone


@pytest.fixture
def left(tmp_path):
    """A state directory of which the supervisor runs two processes, and its slave is gone."""
    (tmp_path / "supervisor").mkdir()
    host = Host(tmp_path / "supervisor")
    client = host.connect()
    for name in ("a", "b"):
        client.start([host.order(name, "sleep", "600")])
        host.running(client, name)
    client.close()
    yield host
    host.clean_up()


def test_all_processes_and_their_supervisor_end(left, tmp_path) -> None:
    """The message has the number of processes."""
    assert stop_all(tmp_path) == "2 processes stopped; the supervisor has ended"
    assert left.alive() == []
    for pid in left.pids:
        wait_gone(pid)
    assert stop_all(tmp_path) == "0 processes stopped; the supervisor has ended"


def test_while_the_slave_runs_it_is_refused(left, tmp_path) -> None:
    """Its own end stops the processes."""
    with (
        only_one(tmp_path, "slave", code="name_taken", remedy=""),
        pytest.raises(Refused, match="Stop it first"),
    ):
        stop_all(tmp_path)
    assert len(left.alive()) == 2


def test_a_process_that_does_not_end_is_named(left, tmp_path) -> None:
    """The supervisor stops it nevertheless."""
    with pytest.raises(RosrmError, match=r"not ended in time: a#1, b#1; supervisor pid \d+"):
        stop_all(tmp_path, longest=0.0)


def test_a_directory_without_a_slave_has_nothing_to_stop(tmp_path) -> None:
    """And none is made."""
    assert "nothing to stop" in stop_all(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
