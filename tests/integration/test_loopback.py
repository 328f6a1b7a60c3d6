"""A private network with only a loopback device, for clusters on one machine."""

from __future__ import annotations

import subprocess
import sys

import pytest

_ENTER = """
from rosrm.testing.loopback import enter_private_network, settings_on_this_machine
before = settings_on_this_machine(7)
print(enter_private_network(), before.discovery_range, before.transports)
after = settings_on_this_machine(7)
print(after.domain, after.discovery_range, after.transports)
"""
_REACH = """
import os, socket
from rosrm.testing.loopback import enter_private_network
entered = enter_private_network()
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here, \\
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
    here.bind(("127.0.0.1", 0))
    here.settimeout(5.0)
    there.sendto(b"heard", here.getsockname())
    said = here.recv(16).decode()
    try:
        there.sendto(b"", ("192.0.2.1", 9))
        out = "a way out"
    except OSError:
        out = "no way out"
print(entered, said, out, os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE"))
"""


def _run(code: str, *before: str) -> list[str]:
    """Return the lines that a Python process printed."""
    command = [*before, sys.executable, "-c", code]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, timeout=30.0
    ).stdout.splitlines()  # fmt: skip


def _may_enter() -> bool:
    return _run("from rosrm.testing.loopback import *; print(enter_private_network())") == ["True"]


@pytest.fixture
def _allowed():
    if not _may_enter():
        pytest.skip("a network namespace needs CAP_SYS_ADMIN and CAP_NET_ADMIN: run as root")


@pytest.mark.usefixtures("_allowed")
def test_in_a_network_of_its_own_all_are_found_by_udp():
    """In a private network discovery needs no range limit, and uses UDP as between hosts."""
    entered, after = _run(_ENTER)
    assert entered.startswith("True")
    assert after == "7 subnet UDPv4"


@pytest.mark.usefixtures("_allowed")
def test_nothing_leaves_it_and_loopback_works():
    """Child processes join ROS in the same way, and no packet leaves the network."""
    assert _run(_REACH) == ["True heard no way out SUBNET"]


@pytest.mark.usefixtures("_allowed")
@pytest.mark.parametrize("missing", ["sys_admin", "net_admin"])
def test_without_the_right_it_stays_where_it_is(missing):
    """Without both rights nothing changes: one alone would leave a network that is down."""
    drop = ("setpriv", f"--bounding-set=-{missing}", f"--inh-caps=-{missing}")
    entered, after = _run(_ENTER, *drop)
    assert (entered.split()[0], after.split()[1:]) == ("False", entered.split()[1:])


def test_up_without_a_loopback_address_says_so_at_once():
    """Otherwise `rosrm up` would wait for its own master without a message."""
    command = ["unshare", "--net", sys.executable, "-m", "rosrm.cli", "up"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if ran.returncode == 1 and "unshare" in ran.stderr:
        pytest.skip(ran.stderr)
    assert ran.returncode == 2
    assert "the loopback interface has no address" in ran.stderr
