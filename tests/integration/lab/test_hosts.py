"""Isolation and resource limits of virtual hosts."""

from __future__ import annotations

import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from rosrm.errors import ConfigError, LabError
from rosrm_lab import DATA, MIB, HostPlan, Lab, uniform
from tests.waiting import PATIENCE, wait_until

PYTHON = [sys.executable, "-ISc"]


def test_each_host_has_a_name_and_processes_of_its_own(lab):
    """Each host has its own init process and sees no process of another host."""
    assert lab.exec("host1", ["hostname"]).stdout == "host1\n"
    assert lab.exec("host2", ["cat", "/proc/sys/kernel/hostname"]).stdout == "host2\n"
    pids = "import os; print([p for p in os.listdir('/proc') if p.isdigit()].__len__())"
    assert int(lab.exec("host1", [*PYTHON, pids]).stdout) == 2  # init and Python


def test_each_host_has_its_own_shared_memory_and_disk(lab):
    """A file written on one host is invisible to the other hosts and to the machine."""
    lab.exec("host1", ["touch", "/dev/shm/mine", f"{DATA}/mine"])
    for path in ("/dev/shm/mine", f"{DATA}/mine"):
        assert lab.exec("host2", ["test", "-e", path], check=False).returncode == 1
        assert not Path(path).exists()
        assert lab.outside("host1", path).exists()


def test_hosts_reach_only_each_other(lab):
    """There is no route out, and the switch is connected only to the hosts."""
    server = lab.popen("host1", [*PYTHON, ECHO], stdout=-1)
    assert server.stdout.readline() == b"ready\n"
    try:
        assert lab.exec("host2", [*PYTHON, ASK, "host1"]).stdout == "hello\n"
    finally:
        server.kill()
        server.communicate()
    out = "import socket; socket.create_connection(('9.9.9.9', 9))"
    refused = lab.exec("host1", [*PYTHON, out], check=False)
    assert "Network is unreachable" in refused.stderr
    from pyroute2 import IPRoute

    from rosrm_lab.plan import switch_namespace

    with IPRoute(netns=switch_namespace(lab.name)) as switch:
        names = {link.get("ifname") for link in switch.get_links()}
        assert names == {"lo", "bridge", "port1", "port2", "port3"}
        assert {a.get("address") for a in switch.get_addr(family=socket.AF_INET)} <= {"127.0.0.1"}


ECHO = """
import socket
s = socket.socket(); s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
s.bind(('', 9000)); s.listen(); print('ready', flush=True)
while True:
    c, _ = s.accept(); c.sendall(c.recv(99)); c.close()
"""
ASK = """
import socket, sys
s = socket.create_connection((sys.argv[1], 9000), 20)
s.sendall(b'hello'); print(s.recv(99).decode())
"""


def test_a_process_over_the_memory_of_its_host_is_killed(lab):
    """The kernel kills the process that exceeds the memory limit; the host stays up."""
    taken = "x = bytearray(%d << 20); print(len(x) >> 20)"
    assert lab.exec("host1", [*PYTHON, taken % 64]).stdout == "64\n"
    assert lab.exec("host1", [*PYTHON, taken % 256], check=False).returncode == -signal.SIGKILL
    assert lab.exec("desk", [*PYTHON, taken % 256]).stdout == "256\n"  # no limit there
    assert lab.is_up("host1")


BURN = """
import time
end = time.monotonic() + 2.0
while time.monotonic() < end: pass
print(time.process_time())
"""


def test_a_host_gets_no_more_than_its_share_of_cpu(lab):
    """Half a core gives a busy process at most one second of CPU time in two."""
    used = float(lab.exec("host1", [*PYTHON, BURN]).stdout)
    assert used < 1.25


def test_beside_the_limits_there_are_none(lab):
    """A process outside the quota, in another group of the same host, may exceed the limits."""
    words = [*PYTHON, "x = bytearray(256 << 20); print(open('/proc/self/cgroup').read())"]
    assert "/host1/free\n" in lab.exec("host1", words, limited=False).stdout


def test_a_disk_can_be_full(lab):
    """The disk has the planned size, less the overhead of the file system."""
    fill = f"open('{DATA}/big', 'wb').write(bytes(64 << 20))"
    assert "No space left" in lab.exec("host1", [*PYTHON, fill], check=False).stderr
    size = "import os; s = os.statvfs('/run/data'); print(s.f_blocks * s.f_frsize)"
    assert 24 * MIB < int(lab.exec("host2", [*PYTHON, size]).stdout) <= 32 * MIB


def test_another_user_can_work_on_a_host(lab):
    """An unprivileged user has a writable folder, and no additional rights."""
    words = ["sh", "-c", f"id -un; touch {DATA}/state/x && echo wrote; echo $HOME"]
    said = lab.exec("host1", words, user="nobody").stdout.split()
    assert said[:2] == ["nobody", "wrote"]
    with pytest.raises(ConfigError, match="no user 'nobody-at-all'"):
        lab.exec("host1", ["true"], user="nobody-at-all")


def test_killing_a_host_is_a_power_cut(lab):
    """All processes die, peers get no packet; disk contents and address survive the next boot."""
    sleepers = [lab.popen("host1", ["sleep", "1000"]) for _ in range(3)]
    server = lab.popen("host1", [*PYTHON, HOLD], stdout=-1)
    assert server.stdout.readline() == b"ready\n"
    client = lab.popen("host2", [*PYTHON, LISTEN, "host1"], stdout=-1)
    assert client.stdout.readline() == b"connected\n"
    lab.exec("host1", ["touch", f"{DATA}/kept", "/dev/shm/lost"])
    lab.exec("host1", ["sync"])

    lab.kill("host1")

    assert [one.wait(PATIENCE) for one in sleepers] == [-signal.SIGKILL] * 3
    assert server.wait(PATIENCE) == -signal.SIGKILL
    server.stdout.close()
    assert client.communicate(timeout=PATIENCE)[0] == b"silence\n"
    assert not lab.pids("host1")
    assert not lab.is_up("host1")
    with pytest.raises(LabError, match=r"host1 .* is off; `rosrm lab boot host1`"):
        lab.exec("host1", ["true"])

    address = lab.address("host1")
    lab.boot("host1")
    assert lab.exec("host1", ["ls", str(DATA)]).stdout.split()[0] == "kept"
    assert lab.exec("host1", ["ls", "/dev/shm"]).stdout == ""
    assert address in lab.exec("host1", [*PYTHON, OWN_ADDRESS, "host1"]).stdout
    again = lab.popen("host1", [*PYTHON, ECHO], stdout=-1)
    assert again.stdout.readline() == b"ready\n"
    assert lab.exec("host2", [*PYTHON, ASK, "host1"]).stdout == "hello\n"
    again.kill()
    again.communicate()


HOLD = ECHO.replace("c.sendall(c.recv(99)); c.close()", "c.recv(99)")
LISTEN = """
import socket, sys
s = socket.create_connection((sys.argv[1], 9000), 20); print('connected', flush=True)
s.settimeout(3)
try: print('end' if s.recv(9) == b'' else 'data')
except TimeoutError: print('silence')
except OSError as error: print(error)
"""
OWN_ADDRESS = "import socket, sys; print(socket.gethostbyname(sys.argv[1]))"


def test_booting_a_host_that_is_up_is_refused(lab):
    """The refused boot leaves the host's processes alone."""
    sleeper = lab.popen("host1", ["sleep", "1000"])
    with pytest.raises(LabError, match=r"host host1 .* is up already"):
        lab.boot("host1")
    assert sleeper.poll() is None
    sleeper.kill()
    sleeper.wait()


def test_the_status_has_state_and_usage_of_each_host(lab):
    """The status has the fields of `rosrm lab status --json`."""
    sleeper = lab.popen("host1", ["sleep", "1000"])
    wait_until(lambda: lab.status()[0].processes == 1, "the process is counted")
    lab.kill("host2")
    one, two, desk = lab.status()
    assert (one.state, one.memory, one.cpu, one.disk) == ("up", 128 * MIB, 0.5, 32 * MIB)
    assert one.memory_used < one.memory
    assert 0 < one.disk_used < one.disk
    assert (two.state, two.disk_used, two.processes) == ("off", None, 0)
    assert (desk.memory, desk.cpu) == (None, None)
    sleeper.kill()
    sleeper.wait()


def test_two_labs_are_independent(lab, name):
    """Each lab has its own addresses, and neither reaches the other."""
    other = f"{name}-b"
    with Lab(other, uniform(1, disk=16 * MIB)) as second:
        assert second.address("host1") != lab.address("host1")
        assert not second.plan.subnet.overlaps(lab.plan.subnet)
        ask = second.exec("host1", [*PYTHON, ASK, lab.address("host1")], check=False)
        assert "unreachable" in ask.stderr
        with pytest.raises(ConfigError, match=f"is in use: lab '{name}' has"):
            Lab(f"{name}-c", uniform(1), subnet=lab.plan.subnet).up()
        with pytest.raises(LabError, match="is up already, with host1, host2, desk"):
            Lab(name, uniform(1)).up()
    assert lab.is_up("host1")


def test_a_range_of_this_machine_is_refused(name):
    """A subnet of this machine's network is refused as ambiguous."""
    from rosrm_lab.network import ranges_in_use

    used = ranges_in_use()
    if not used:
        pytest.skip("this machine has no network")
    with pytest.raises(ConfigError, match=f"is in use: {used[0][1]} has {used[0][0]}"):
        Lab(name, [HostPlan("host1")], subnet=used[0][0]).up()


def test_the_machine_keeps_its_name_and_its_mounts(lab):
    """Mounts and host names of a lab are invisible to the machine."""
    assert os.uname().nodename not in {"host1", "host2", "desk"}
    assert str(DATA) not in Path("/proc/self/mounts").read_text()
