"""Control groups of version 2 on a real hierarchy, without the controllers that version 1 may have.

The controllers of memory and cpu are often mounted as version 1; then these tests take another one
for them, because the kernel's rules on delegation are the same for all.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.core.supervisor.rules import LimitRule
from rosrm.runtime import cgroups
from rosrm.supervisor import spawn, spawn_into
from rosrm.supervisor.group_trees import Tree
from rosrm.supervisor.instance_groups import InstanceGroups, limit_files
from tests.starting import executed
from tests.waiting import wait_until

KEY = ("camera", 1)
#: Enters the group of its first argument; takes one controller for those of memory and cpu; then
#: prepares its group, and prints its own group and the controllers of the groups below the first.
DELEGATE = """
import os, sys
from rosrm.runtime import cgroups
from rosrm.supervisor import group_trees
group, controller, state = sys.argv[1:]
cgroups.write(f"{group}/cgroup.procs", "0")
cgroups.LIMITING = group_trees._CONTROLLERS = (controller,)
cgroups.delegate()
print(open("/proc/self/cgroup").read().rpartition("0::")[2].strip())
print(cgroups.read(f"{group}/cgroup.subtree_control").strip())
trees, missing = group_trees.find(state)
print([tree.top for tree in trees if tree.version == 2], missing.get("limits." + controller))
"""


@pytest.fixture
def group(tmp_path: Path) -> Iterator[str]:
    """Make a group of version 2 for the test."""
    mount = next((one for one in cgroups.mounts() if one.version == 2), None)
    own = cgroups.own_group(mount) if mount else None
    if own is None:
        pytest.skip("no control groups of version 2 are mounted")
    path = f"{own}/rosrm-test-{os.getpid()}-{tmp_path.parent.name}-{tmp_path.name}"
    try:
        Path(path).mkdir()
    except OSError as error:
        pytest.skip(f"no group of version 2 can be made: {error}")
    yield path
    for folder, _, _ in os.walk(path, topdown=False):
        with contextlib.suppress(OSError):
            Path(folder, "cgroup.kill").write_text("1")
        wait_until(lambda folder=folder: not cgroups.read(f"{folder}/cgroup.procs"), "its end")
        Path(folder).rmdir()


@pytest.fixture(autouse=True)
def alone() -> Iterator[None]:
    """Let no other thread of the test run ask for the interpreter while this one forks by clone3.

    The supervisor has one thread. A child that had to yield to another one would wait for ever.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(1000.0)
    yield
    sys.setswitchinterval(before)


@pytest.fixture
def groups(group: str) -> InstanceGroups:
    """Return groups of instances below the group of the test, without controllers."""
    return InstanceGroups([Tree(2, f"{group}/top", group, ())])


def start(groups: InstanceGroups, *argv: str, nice: int = 0, **options) -> int:
    """Start a program in the group of the instance; return its pid."""
    program = spawn.Program(argv, {"PATH": os.environ["PATH"]}, "/", nice=nice)
    with Path(os.devnull).open("r+") as null, groups.inside(KEY) as inside:
        attempt = spawn.begin(program, null.fileno(), null.fileno(), group=inside, **options)
        return executed(attempt)


@pytest.fixture(params=["clone3", "without clone3"])
def way(request, monkeypatch) -> None:
    """Let the process start in its group, or enter it, as where clone3 is not permitted."""
    if request.param != "clone3":
        monkeypatch.setattr(spawn_into, "_CLONE3", 0xFFFF)


def test_a_process_starts_in_its_group_and_is_killed_with_it(groups, way) -> None:
    """The process leads a session of its own, and all its descendants are in the group."""
    groups.make(KEY, LimitRule(), realtime=False)
    pid = start(groups, "sh", "-c", "setsid sleep 1000 & sleep 1000")
    assert os.getsid(pid) == pid
    wait_until(lambda: len(groups.members(KEY)) == 3, "its children")
    assert pid in groups.members(KEY)
    groups.kill(KEY)
    assert os.waitpid(pid, 0) == (pid, 9)
    wait_until(lambda: not groups.members(KEY), "the end of its children")
    groups.remove(KEY, 0.0)
    assert groups.members(KEY) is None
    assert groups.deadline() is None


def test_a_program_that_cannot_be_executed_is_an_error(groups, way) -> None:
    """The text is that of other starts, and no child is left."""
    groups.make(KEY, LimitRule(), realtime=False)
    with pytest.raises(spawn.SpawnError, match="no executable '/nowhere/to/be/found' exists"):
        start(groups, "/nowhere/to/be/found")
    with pytest.raises(spawn.SpawnError, match="'ls' cannot be started: embedded null byte"):
        start(groups, "ls", "a\0b")
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)


def test_signals_are_as_for_other_starts(groups, way, tmp_path) -> None:
    """None is ignored or blocked, although Python ignores some."""
    groups.make(KEY, LimitRule(), realtime=False)
    report, look = tmp_path / "report", "grep -E '^Sig(Blk|Ign)' /proc/self/status"
    os.waitpid(start(groups, "sh", "-c", f"{look} > {report}"), 0)
    assert report.read_text() == subprocess.check_output(["sh", "-c", look], text=True)


def test_a_group_in_use_is_removed_later(groups) -> None:
    """Processes that are left in it are killed."""
    groups.make(KEY, LimitRule(), realtime=False)
    pid = start(groups, "sleep", "1000")
    groups.remove(KEY, now=10.0)
    assert groups.deadline() == pytest.approx(10.2)
    assert os.waitpid(pid, 0) == (pid, 9)
    wait_until(lambda: (groups.look(11.0), groups.deadline() is None)[1], "the removal")


def test_a_run_that_begins_before_the_removal_lives(groups) -> None:
    """A group that is made again is no longer to be removed."""
    groups.make(KEY, LimitRule(), realtime=False)
    former = start(groups, "sleep", "1000")
    groups.remove(KEY, now=10.0)
    assert os.waitpid(former, 0) == (former, 9)
    groups.make(KEY, LimitRule(), realtime=False)
    pid = start(groups, "sleep", "1000")
    groups.look(11.0)
    assert groups.members(KEY) == [pid]
    groups.remove(KEY, now=12.0)
    assert os.waitpid(pid, 0) == (pid, 9)
    wait_until(lambda: (groups.look(13.0), groups.deadline() is None)[1], "the removal")


def test_an_agent_moves_out_of_the_way_of_its_groups(group: str, tmp_path: Path) -> None:
    """Version 2 gives controllers to no group below one with processes in it."""
    own, enabled, found = delegated(group, tmp_path)
    assert own.endswith("/rosrm-agent")
    assert enabled == controller()
    assert f"{group}/rosrm-state-" in found


def test_an_agent_beside_other_processes_stays_and_says_why(group: str, tmp_path: Path) -> None:
    """The agent moves no process of others."""
    other = subprocess.Popen(["sleep", "1000"])
    try:
        cgroups.write(f"{group}/cgroup.procs", str(other.pid))
        own, enabled, found = delegated(group, tmp_path)
    finally:
        other.kill()
        other.wait()
    assert own.endswith(Path(group).name)
    assert not enabled
    assert found.startswith("[] ")
    assert not Path(group, "rosrm-agent").exists()


def test_a_mount_whose_path_is_not_utf8_changes_nothing(tmp_path: Path) -> None:
    """A USB stick with such a name ended the slave at its start."""
    disk = tmp_path / os.fsdecode(b"caf\xe9")
    disk.mkdir()
    find = (
        "from rosrm.runtime import cgroups; from rosrm.supervisor import group_trees; "
        f"print(len(cgroups.mounts()), group_trees.find({str(tmp_path)!r}).trees)"
    )
    words = (sys.executable, find, str(disk))
    without, beside = (
        subprocess.run(
            ["unshare", "--mount", "sh", "-c", f'{first} && exec "$0" -c "$1"', *words],
            capture_output=True, text=True, check=False, timeout=60,
        )
        for first in ("true", 'mount -t tmpfs none "$2"')
    )  # fmt: skip
    if without.returncode:
        pytest.skip(f"no mount namespace can be made: {without.stderr}")
    assert not beside.returncode, beside.stderr
    assert beside.stdout == without.stdout


def controller() -> str:
    """Return a controller of version 2 that a group with processes cannot give on."""
    mount = next(one for one in cgroups.mounts() if one.version == 2)
    offered = cgroups.read(f"{mount.point}/cgroup.controllers").split()
    fit = [name for name in ("memory", "hugetlb", "io") if name in offered]
    return fit[0] if fit else pytest.skip("all controllers are mounted as version 1")


def delegated(group: str, state: Path) -> list[str]:
    """Run an agent in a group; return its group then, the controllers, and what it found."""
    name = controller()
    switch = Path(group).parent / "cgroup.subtree_control"
    before = switch.read_text()
    cgroups.enable(str(switch.parent), (name,))
    command = [sys.executable, "-c", DELEGATE, group, name, str(state)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert not ended.returncode, ended.stderr
    if name not in before:
        with contextlib.suppress(OSError):  # a group below has it, too, until the test has ended
            Path(group, "cgroup.subtree_control").write_text(f"-{name}")
            switch.write_text(f"-{name}")
    return ended.stdout.splitlines()


def test_limits_are_those_of_version_2() -> None:
    """The instance ends as a whole at its limit of memory, and swap does not extend it."""
    limits = LimitRule(memory=512e6, memory_high=4e8, cpu=1.5)
    assert {file: content for _, file, content in limit_files(2, limits)} == {
        "memory.max": "512000000", "memory.swap.max": "0", "memory.oom.group": "1",
        "memory.high": "400000000", "cpu.max": "30000 20000",
    }  # fmt: skip
