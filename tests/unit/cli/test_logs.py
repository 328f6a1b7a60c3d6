"""`rosrm logs`: finds the slave that holds the log, copies it, and follows the process."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from rosrm.errors import Refused

from .conftest import event, process


@dataclass(frozen=True)
class LogPart:
    content: bytes
    next_offset: int
    generation: int
    ended: bool


class Log:
    """One log file on a slave."""

    def __init__(self, content=b"", *, ended=True):
        self.content, self.generation, self.ended = content, 1, ended

    def read(self, offset, most):
        start = max(0, len(self.content) + offset) if offset < 0 else offset
        part = self.content[start : start + most]
        end = start + len(part)
        return LogPart(part, end, self.generation, self.ended and end == len(self.content))


@pytest.fixture
def slave(client, monkeypatch):
    """Logs by host and instance; the client reads from them."""
    logs = {}

    def read_log(host, process, number, offset, max_bytes):
        client.asked.append(("read_log", host, process, number))
        return logs[host, number].read(offset, max_bytes)

    client.read_log = read_log
    return logs


def test_a_log_is_copied_byte_by_byte_in_parts(rosrm, client, slave, monkeypatch):
    monkeypatch.setattr("rosrm.cli.log_following._CHUNK", 3)
    slave["alpha", 1] = Log("one\ntwo ä\n".encode(), ended=False)
    result = rosrm("logs", "talker")
    assert (result.code, result.out) == (0, "one\ntwo ä\n")


def test_only_the_end_is_shown_with_tail(rosrm, client, slave):
    slave["alpha", 1] = Log(b"x" * 5000 + b"end\n")
    assert rosrm("logs", "talker", "--tail", "4").out == "end\n"
    assert rosrm("logs", "talker", "--tail", "1kB").out == "x" * 996 + "end\n"
    result = rosrm("logs", "talker", "--tail", "much")
    assert (result.code, "--tail: 'much' is not a number" in result.err) == (2, True)


def test_the_log_of_an_ended_process_is_found_by_its_events(rosrm, client, slave):
    client.processes = [process("job", "finished", "", number=0, kind="job")]
    client.events = [event(1, process="job", host="beta"), event(2, process="job", host="")]
    slave["beta", 0] = Log(b"done\n")
    assert rosrm("logs", "job").out == "done\n"


def test_another_host_may_be_named(rosrm, client, slave):
    slave["beta", 0] = Log(b"earlier\n")
    assert rosrm("logs", "talker", "--host", "beta").out == "earlier\n"


def test_a_process_that_has_not_run_or_is_unknown_is_said(rosrm, client, slave):
    client.events = []
    result = rosrm("logs", "next")
    assert result.code == 1
    assert "next has not run yet: it is queued. no host has room" in result.err
    result = rosrm("logs", "nobody")
    assert result.code == 1
    assert "there is no process 'nobody'" in result.err


def test_follow_shows_what_is_added_and_a_rotated_log_from_its_start(
    rosrm, client, slave, monkeypatch
):
    log = slave["alpha", 1] = Log(b"one\n", ended=False)
    steps = iter(["grow", "rotate", "end"])

    def later(seconds):
        step = next(steps)
        if step == "grow":
            log.content += b"two\n"
        elif step == "rotate":
            log.content, log.generation = b"three\n", 2
        else:
            log.ended = True
            client.processes = [process("talker", "finished")]

    monkeypatch.setattr("time.sleep", later)
    result = rosrm("logs", "talker", "-f")
    assert (result.code, result.out) == (0, "one\ntwo\nthree\n")


def test_follow_goes_on_where_the_process_moves_to(rosrm, client, slave, monkeypatch):
    slave["alpha", 1] = Log(b"on alpha\n")
    slave["beta", 2] = Log(b"on beta\n")
    moves = iter([process("talker", "running", "beta", number=2), process("talker", "finished")])

    def later(seconds):
        client.processes = [next(moves)]

    monkeypatch.setattr("time.sleep", later)
    result = rosrm("logs", "talker", "-f")
    assert (result.code, result.out) == (0, "on alpha\non beta\n")
    assert "--- talker now runs on beta ---" in result.err


def test_follow_waits_for_a_log_that_its_host_is_about_to_begin(rosrm, client, slave, monkeypatch):
    there = client.read_log

    def read_log(host, process, number, offset, max_bytes):
        if not slave:
            raise Refused("this host has no log of talker", "unknown")
        return there(host, process, number, offset, max_bytes)

    def later(seconds):
        slave["alpha", 1] = Log(b"begun\n")
        client.processes = [process("talker", "finished")]

    client.read_log = read_log
    assert rosrm("logs", "talker").code == 1
    monkeypatch.setattr("time.sleep", later)
    result = rosrm("logs", "talker", "-f")
    assert (result.code, result.out) == (0, "begun\n")
