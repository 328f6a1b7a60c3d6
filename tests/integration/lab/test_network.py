"""Effects of `cut`, `loss`, `delay` and `heal` on packets."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from rosrm.errors import ConfigError, LabError

PYTHON = [sys.executable, "-ISc"]
PORT = 9100
#: Receives packets for a while, then prints their number per sender.
HEAR = """
import collections, socket, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
s.bind(('', 9100)); print('ready', flush=True)
heard, end = collections.Counter(), None
while True:
    s.settimeout(None if end is None else max(0.01, end - time.monotonic()))
    try: data, (sender, _) = s.recvfrom(999)
    except TimeoutError: break
    if data == b'end': end = time.monotonic() + 0.3
    else: heard[sender] += 1
print(dict(heard))
"""
SPEAK = """
import socket, sys
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for _ in range(int(sys.argv[2])): s.sendto(b'x' * 100, (sys.argv[1], 9100))
"""
#: Sent from the host to itself, because the packet that ends the reception must not be lost.
END = """
import socket
socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'end', ('127.0.0.1', 9100))
"""


def heard(lab, at, *speakers, number=50):
    """Return the number of packets that a host receives from each speaker."""
    listener = lab.popen(at, [*PYTHON, HEAR], stdout=subprocess.PIPE)
    assert listener.stdout.readline() == b"ready\n"
    for speaker in speakers:
        lab.exec(speaker, [*PYTHON, SPEAK, lab.address(at), str(number)])
    lab.exec(at, [*PYTHON, END])
    said, _ = listener.communicate(timeout=30)
    counts = eval(said)
    return [counts.get(lab.address(speaker), 0) for speaker in speakers]


def test_a_cut_in_one_direction_is_one_direction(lab):
    """`in` cuts packets to the host, `out` packets from it; other hosts are unaffected."""
    lab.cut("host1", "in")
    assert heard(lab, "host1", "host2", "desk") == [0, 0]
    assert heard(lab, "host2", "host1", "desk") == [50, 50]
    lab.heal("host1")
    lab.cut("host1", "out")
    assert heard(lab, "host1", "host2", "desk") == [50, 50]
    assert heard(lab, "host2", "host1", "desk") == [0, 50]
    lab.cut("host1")
    assert heard(lab, "host1", "host2") == [0]
    lab.heal("host1")
    assert heard(lab, "host1", "host2") == [50]
    assert heard(lab, "host2", "host1") == [50]


def test_multicast_is_cut_too(lab):
    """A cut also stops multicast packets, by which DDS discovers its peers."""
    listen = HEAR.replace(
        "print('ready'",
        "s.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, "
        "socket.inet_aton('239.255.0.1') + socket.inet_aton(sys.argv[1])); print('ready'",
    )
    send_from = "s.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, "
    speak = SPEAK.replace("for _", f"{send_from}socket.inet_aton(sys.argv[3]))\nfor _")
    counts = []
    for fault in (None, "out", "heal"):
        if fault == "out":
            lab.cut("host2", "out")
        elif fault == "heal":
            lab.heal("host2")
        hears = lab.popen("host1", [*PYTHON, listen, lab.address("host1")], stdout=subprocess.PIPE)
        assert hears.stdout.readline() == b"ready\n"
        lab.exec("host2", [*PYTHON, speak, "239.255.0.1", "20", lab.address("host2")])
        lab.exec("host1", [*PYTHON, END])
        counts.append(eval(hears.communicate(timeout=30)[0]).get(lab.address("host2"), 0))
    assert counts == [20, 0, 20]


def test_a_share_of_the_packets_is_lost(lab):
    """A loss of 20 % drops 600 of 3,000 packets, within six standard deviations (131)."""
    lab.loss("host1", 0.2, "in")
    (arrived,) = heard(lab, "host1", "host2", number=3000)
    assert 2400 - 131 < arrived < 2400 + 131
    assert heard(lab, "host2", "host1", number=300) == [300]
    lab.loss("host1", 1.0)
    assert heard(lab, "host2", "host1") == [0]
    lab.loss("host1", 0.0)
    assert heard(lab, "host1", "host2", number=300) == [300]


def test_faults_add_up_and_are_healed_together(lab):
    """The status lists all faults of a host; `heal` removes all."""
    lab.loss("host1", 0.01)
    lab.cut("host1", "out")
    assert lab.status()[0].network == "in: loss 1 %; out: cut, loss 1 %"
    lab.heal("host1")
    assert lab.status()[0].network == ""


def test_a_cut_outlives_a_power_cut(lab):
    """A cut belongs to the cable, so a rebooted host is still cut off."""
    lab.cut("host1", "in")
    lab.kill("host1")
    lab.boot("host1")
    assert heard(lab, "host1", "host2") == [0]
    assert heard(lab, "host2", "host1") == [50]


ROUND = """
import socket, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.settimeout(5)
s.sendto(b'x', (sys.argv[1], 9200)); s.recv(9)
def seconds():
    begin = time.monotonic()
    s.sendto(b'x', (sys.argv[1], 9200)); s.recv(9)
    return time.monotonic() - begin
print(min(seconds() for _ in range(5)))
"""
BACK = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(('', 9200)); print('ready', flush=True)
while True: s.sendto(*s.recvfrom(9))
"""


def test_packets_are_late_or_the_kernel_cannot(lab):
    """A delay of 50 ms each way gives 100 ms per round trip; without netem an error, no change."""
    back = lab.popen("host2", [*PYTHON, BACK], stdout=subprocess.PIPE)
    assert back.stdout.readline() == b"ready\n"
    try:
        lab.delay("host1", 0.05)
    except LabError as error:
        said = str(error)
    else:
        said = ""
    if said:
        assert "no netem" in said
        assert "Nothing was changed" in said
        assert lab.status()[0].network == ""
        assert float(lab.exec("host1", [*PYTHON, ROUND, "host2"]).stdout) < 0.05
    else:
        assert float(lab.exec("host1", [*PYTHON, ROUND, "host2"]).stdout) >= 0.1
        lab.kill("host1")
        lab.boot("host1")
        assert float(lab.exec("host1", [*PYTHON, ROUND, "host2"]).stdout) >= 0.1
        lab.heal("host1")
        assert float(lab.exec("host1", [*PYTHON, ROUND, "host2"]).stdout) < 0.05
    back.kill()
    back.communicate()


def test_the_end_of_a_delay_takes_its_queue_away(lab):
    """A kernel without netem shows the removal, too, with another queue."""
    from pyroute2 import IPRoute

    from rosrm_lab import network
    from rosrm_lab.plan import switch_namespace
    from rosrm_lab.wires import Wire

    name = switch_namespace(lab.name)

    def kinds(switch, index):
        return {queue.get("kind") for queue in switch.get_qdiscs(index=index)}

    with IPRoute(netns=name) as switch:
        (port,) = switch.link_lookup(ifname="port1")
        before = kinds(switch, port)
        switch.tc("replace", "tbf", index=port, rate="8mbit", burst=32000, latency="50ms")
        assert kinds(switch, port) == {"tbf"}
        network._set_delay(name, "port1", Wire())
        assert kinds(switch, port) == before


def test_bad_input_changes_nothing(lab):
    """Each bad argument gives one clear error."""

    def seen() -> list[tuple]:
        return [(row.name, row.state, row.network) for row in lab.status()]

    before = seen()
    for change, *arguments in (
        (lab.cut, "host9"), (lab.cut, "host1", "sideways"), (lab.loss, "host1", 1.5),
        (lab.delay, "host1", -1.0), (lab.kill, "host9"), (lab.boot, "host9"),
    ):  # fmt: skip
        with pytest.raises(ConfigError):
            change(*arguments)
    assert seen() == before


def test_changing_the_network_takes_a_moment_only(lab):
    """Ten changes take less than 10 s, because a chaos test makes many."""
    begin = time.monotonic()
    for _ in range(5):
        lab.cut("host1", "in")
        lab.heal("host1")
    assert time.monotonic() - begin < 10.0
