"""Probes on real processes, and on the control groups of this machine."""

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

import psutil
import pytest

import rosrm_resources.plugin
from rosrm.extensions.registry import Registry
from rosrm.slave.sampler import Sampler
from rosrm.slave.sessions import SessionTable
from rosrm.testing import FakeSessions, probe_context
from rosrm_resources.cgroups import find_group
from rosrm_resources.cpu import CgroupCpu, GroupTime, MachineCpu, SliceCpu
from rosrm_resources.disk import DiskWriters
from rosrm_resources.memory import CgroupMemory, SliceMemory
from rosrm_resources.plugin import register_probes
from tests.waiting import wait_until

BURN = "while True: pass"
HOLD = "import sys; block = bytearray(int(sys.argv[1])); print('ready', flush=True); input()"
WRITE = """
import os, sys
with open(sys.argv[1], "wb") as file:
    file.write(bytes(int(sys.argv[2])))
    file.flush()
    os.fsync(file.fileno())
    print("ready", flush=True)
    input()
"""
MIB = 2**20


@pytest.fixture
def start():
    """Yield a function that starts session leaders; kill their sessions at the end."""
    started = []

    def run(code, *arguments, ready=False):
        process = subprocess.Popen(
            [sys.executable, "-S", "-c", code, *arguments],
            start_new_session=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        started.append(process)
        if ready:
            assert process.stdout.readline() == b"ready\n"
        return process

    yield run
    for process in started:
        with contextlib.suppress(ProcessLookupError):  # it may have ended already
            os.killpg(process.pid, 9)
        process.wait(10)
        process.stdin.close()
        process.stdout.close()


def watch(seconds, read):
    """Call `read` ten times a second for `seconds`; return its last result."""
    tick = threading.Event()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        answer = read()
        tick.wait(0.1)
    return answer


def burnt(pid):
    """Return the CPU seconds of a process, by psutil."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def test_slice_cpu_is_what_the_process_burns(start):
    """Over two seconds the reading equals the CPU time that the process received."""
    sessions = SessionTable()
    gauge = SliceCpu(1.0, sessions, 2.0)
    burner = start(BURN)
    sessions.add(burner.pid)
    gauge.usage()
    before, begun = burnt(burner.pid), time.monotonic()
    usage = watch(2.0, gauge.usage)
    share = (burnt(burner.pid) - before) / (time.monotonic() - begun)
    assert usage == pytest.approx(share, abs=0.15)
    gauge.close()


def test_slice_cpu_of_an_ended_session_neither_jumps_nor_lasts(start):
    """A session removed late, after the kill: no reading exceeds the machine's cores."""
    sessions = SessionTable()
    gauge = SliceCpu(1.0, sessions, 1.0)
    burner = start(BURN)
    sessions.add(burner.pid)
    watch(1.0, gauge.usage)
    used = burnt(burner.pid)
    burner.kill()
    burner.wait(10)
    highest = watch(0.3, gauge.usage)
    sessions.remove(burner.pid, used)
    for _ in range(12):
        highest = max(highest, watch(0.1, gauge.usage))
    assert highest <= os.cpu_count() + 0.3
    assert gauge.usage() < 0.1
    gauge.close()


def test_slice_memory_is_what_the_processes_hold(start):
    """Two holders of 30 and 50 MiB raise the reading by as much."""
    sessions = SessionTable()
    gauge = SliceMemory(1000.0 * MIB, sessions)
    bare = start(HOLD, "0", ready=True)
    sessions.add(bare.pid)
    own = gauge.usage()
    for size in (30, 50):
        sessions.add(start(HOLD, str(size * MIB), ready=True).pid)
    assert gauge.usage() == pytest.approx(3 * own + 0.080, abs=0.005)
    gauge.close()


def test_a_slice_uses_what_its_processes_use(start):
    """`rosrm hosts` shows the sum of `rosrm ps`, because both count the same memory."""
    sessions = SessionTable()
    gauge = SliceMemory(1000.0 * MIB, sessions)
    for _ in range(10):
        sessions.add(start(HOLD, str(10 * MIB), ready=True).pid)
    sessions.refresh(0.0)
    used = sum(one.memory for one in sessions.usage().values())
    assert used > 100 * MIB
    assert gauge.usage() * gauge.capacity == pytest.approx(used, rel=0.03)
    gauge.close()


def test_writers_of_a_disk_are_found(start, tmp_path):
    """A process counts with what it has written if it writes much, and to this file system."""
    if Path("/dev/shm").stat().st_dev == tmp_path.stat().st_dev or not on_a_disk(tmp_path):
        pytest.skip("the temporary directory is in memory, where the kernel counts no bytes")
    large = start(WRITE, str(tmp_path / "large"), str(20 * MIB), ready=True)
    small = start(WRITE, str(tmp_path / "small"), str(MIB), ready=True)
    with tempfile.NamedTemporaryFile(dir="/dev/shm") as elsewhere:
        away = start(WRITE, elsewhere.name, str(20 * MIB), ready=True)
        pids = (large.pid, small.pid, away.pid)
        written = DiskWriters(tmp_path, 10.0 * MIB, FakeSessions(pids)).written()
    assert written == {large.pid: pytest.approx(20 * MIB, rel=0.1)}


def on_a_disk(path):
    """Return True if the kernel counts bytes that this process writes there."""
    before = psutil.Process().io_counters().write_bytes
    file = path / "probe"
    file.write_bytes(bytes(MIB))
    return psutil.Process().io_counters().write_bytes > before


def test_sessions_find_the_children(start):
    """One refresh finds the children; the refresh after a child's end removes the child."""
    shell = subprocess.Popen(
        ["sh", "-c", "sleep 300 & sleep 300 & read line; kill $!; wait $!; read line"],
        start_new_session=True, stdin=subprocess.PIPE, bufsize=0,
    )  # fmt: skip
    try:
        table = SessionTable()
        table.add(shell.pid)
        wait_until(lambda: table.refresh(time.monotonic()) or len(table.pids()) == 3, "3 pids")
        assert table.usage()[shell.pid].memory > 0
        shell.stdin.write(b"\n")
        wait_until(lambda: table.refresh(time.monotonic()) or len(table.pids()) == 2, "2 pids")
    finally:
        os.killpg(shell.pid, 9)
        shell.wait(10)
        shell.stdin.close()


def test_an_adopted_process_has_its_descendants(start):
    """The other processes of its session are not its own, such as the shell that started it."""
    shell = subprocess.Popen(
        ["sh", "-c", 'sh -c "sleep 300 & echo \\$\\$; wait" & sleep 300 & read line'],
        start_new_session=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0,
    )  # fmt: skip
    try:
        adopted = int(shell.stdout.readline())
        table = SessionTable()
        table.add(adopted)
        wait_until(lambda: table.refresh(time.monotonic()) or len(table.pids()) == 2, "2 pids")
        assert table.members(adopted)[0] == adopted
        assert shell.pid not in table.pids()
        assert table.usage()[adopted].memory > 0
    finally:
        os.killpg(shell.pid, 9)
        shell.wait(10)
        shell.stdin.close()
        shell.stdout.close()


def test_machine_cpu_is_what_psutil_reads(start):
    """Probe and psutil measure the same two seconds while a process is busy."""
    start(BURN)
    gauge = MachineCpu(2.0)
    psutil.cpu_percent(None)
    usage = watch(2.0, gauge.usage)
    assert usage == pytest.approx(psutil.cpu_percent(None) / 100, abs=0.15)
    assert usage > 0.1
    gauge.close()


def test_default_probes_are_quick_and_sane():
    """A whole cycle of the default set takes far less than a hundredth of 0.1 s."""
    probes = Registry.of(resources=rosrm_resources.plugin).probes(None, probe_context())
    assert {"cpu", "memory", "disk"} <= {probe.name for probe in probes.made}
    assert set(probes.absent) <= {"gpu"}
    sampler = Sampler(probes.made)
    sample = sampler.first()
    assert sample.stale == 0
    assert all(0.0 <= usage <= 1.0 for usage in sample.usage)
    sampler.close()


def test_default_probes_are_lean():
    """Default probes import neither psutil nor pydantic, because the slave's memory is limited."""
    code = (
        "import sys; import rosrm_resources.plugin as plugin\n"
        "from pathlib import Path; from rosrm.extensions.contracts import ProbeContext\n"
        "from rosrm.extensions.registry import Registry\n"
        "Registry.of(resources=plugin).probes(None, ProbeContext('machine', {}, Path('/'), None))\n"
        "print(*sorted({'psutil', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.stdout.split() == []


# --- control groups of this machine -----------------------------------------------------------


@pytest.fixture
def memory_group():
    group = find_group("memory")
    if group is None or not any(group.directory.glob("memory.*")):
        pytest.skip("no control group with the memory controller is mounted here")
    return group


def test_memory_of_the_own_group(memory_group):
    """The reading is the kernel's figure less the inactive cache, in either version."""
    v1 = memory_group.version == 1
    current = memory_group.directory / ("memory.usage_in_bytes" if v1 else "memory.current")
    if not current.exists():
        pytest.skip("this process is in the root group")
    gauge = CgroupMemory([(memory_group.directory, 2.0**40)], memory_group.version)
    usage = gauge.usage() * 2.0**40
    assert 0 < usage <= int(current.read_text()) * 1.05 + 16 * MIB
    gauge.close()


def test_cpu_time_of_the_own_group():
    """The CPU time grows, by no more than the cores of the machine allow."""
    group = find_group("cpu")
    if group is None:
        pytest.skip("no control group with the cpu controller is mounted here")
    used = GroupTime(group, group.directory, Path("/"))
    before, begun = used.seconds(), time.monotonic()
    while time.process_time() % 0.1 < 0.09:  # burn some CPU time
        pass
    grown, passed = used.seconds() - before, time.monotonic() - begun
    assert 0 < grown <= os.cpu_count() * (passed + 0.1)
    used.close()


INSIDE = """
import sys, time
from rosrm_resources.memory import CgroupMemory
from rosrm_resources.cpu import CgroupCpu
memory, cpu = CgroupMemory.find(), CgroupCpu.find(1.0)
before = memory.usage()
block = bytearray(20 * 2**20)
end = time.monotonic() + 1.5
while time.monotonic() < end:
    usage = cpu.usage()
print(memory.capacity, memory.usage() - before, cpu.capacity, usage)
"""


def test_limited_group_of_version_1(tmp_path):
    """In a real group of 256 MiB and half a core, both limits are the capacity and take effect."""
    groups = {name: find_group(name) for name in ("memory", "cpu", "cpuacct")}
    if any(group is None or group.version != 1 for group in groups.values()):
        pytest.skip("this machine has no control groups of version 1")
    name = f"rosrm-test-{os.getpid()}"
    made = []
    try:
        try:
            for directory in dict.fromkeys(group.directory / name for group in groups.values()):
                directory.mkdir()
                made.append(directory)
            (groups["memory"].directory / name / "memory.limit_in_bytes").write_text("256M")
            (groups["cpu"].directory / name / "cpu.cfs_quota_us").write_text("50000")
        except OSError as error:
            pytest.skip(f"control groups cannot be made here: {error}")
        enter = "".join(f"echo $$ > {directory}/cgroup.procs; " for directory in made)
        done = subprocess.run(
            ["sh", "-ec", f'{enter} exec "$0" -c "$1"', sys.executable, INSIDE],
            capture_output=True, text=True, timeout=60, check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        capacity, grown, cores, busy = map(float, done.stdout.split())
    finally:
        for directory in made:
            wait_until(partial(_removed, directory), "no process in the group")
    assert (capacity, cores) == (256 * MIB, 0.5)
    assert grown == pytest.approx(20 / 256, abs=0.02)
    assert 0.3 < busy < 1.35  # a busy machine may give less than the quota


def test_group_of_this_process_is_read_or_is_the_machine():
    """The scope `cgroup` gives readings on any machine."""
    for offer in register_probes()[:2]:
        probe = offer.create(offer.options(), probe_context("cgroup"))
        assert probe.resources[0].scope in ("cgroup", "machine")
        assert probe.read()[0].usage >= 0
        probe.close()
    assert CgroupCpu.find(1.0) is None or CgroupCpu.find(1.0).capacity > 0


def _removed(directory):
    try:
        directory.rmdir()
    except OSError:  # its last process is still exiting
        return False
    return True
