"""Link between the process of a component and its container, without ROS."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from rosrm.component import link
from rosrm.runtime.log_tail import last_lines

PLACE = {"ROSRM_MASTER": "lab", "ROSRM_HOST": "left", "ROS_DOMAIN_ID": "3"}


@pytest.fixture
def pair():
    """Yield both ends of a link."""
    ends = socket.socketpair()
    yield ends
    for end in ends:
        end.close()


def test_each_place_has_its_own_containers():
    """Hosts, clusters and domains of one machine are apart; an address fits into a socket."""
    places = [PLACE, *({**PLACE, name: "x"} for name in PLACE)]
    addresses = {link.address(name, place) for place in places for name in ("box", "x" * 300)}
    assert len(addresses) == 2 * len(places)
    assert all(len(one) < 100 for one in addresses)


def test_a_message_arrives(pair):
    """Texts of any language pass."""
    link.send(pair[0], {"plugin": "kamera:Größe"})
    assert link.receive(pair[1]) == {"plugin": "kamera:Größe"}
    assert link.is_own(pair[1])


@pytest.mark.parametrize("line", [b"", b"{", b"[1]\n", b"\xff\n", b'{"a": 1}', b"[" * 9999 + b"\n"])
def test_what_is_no_message_is_none(pair, line):
    """A process may be killed in the middle of a line."""
    pair[0].sendall(line)
    pair[0].close()
    assert link.receive(pair[1]) is None


def test_the_process_of_a_component_says_what_it_lacks():
    """By hand it has no arguments, or no container."""
    by_hand = {name: value for name, value in os.environ.items() if name != "ROSRM_INSTANCE"}
    run = subprocess.run(
        [sys.executable, "-m", "rosrm.component", "box", "m:C"], env=by_hand, check=False,
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert run.returncode == 1
    assert "run it as a process of rosrm, with the arguments CONTAINER PLUGIN" in run.stderr


@pytest.mark.parametrize(
    ("log", "fault"),
    [
        (b"x\nrosrm.component: no container\n", "no container"),
        (b"x" * 9999 + b"\nrosrm.component: late\n", "late"),
        (b"rosrm.component: of an earlier run\nx\n", ""),
        (b"\xff", ""),
        (b"", ""),
    ],
)
def test_the_last_line_of_a_log_says_why_a_component_failed(tmp_path, log, fault):
    """Any other line is of another run, or of another program."""
    path = tmp_path / "log"
    assert link.fault_in(last_lines(path)) == ""
    path.write_bytes(log)
    assert link.fault_in(last_lines(path)) == fault
