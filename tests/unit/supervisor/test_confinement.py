"""Start of an instance within its limits, where the host cannot enforce all of them."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.core.supervisor.rules import Key, LimitRule
from rosrm.runtime import cgroups
from rosrm.supervisor import group_trees, instance_groups
from rosrm.supervisor.confinement import Confinement
from rosrm.supervisor.group_trees import Tree
from rosrm.supervisor.instance_groups import InstanceGroups, LimitRefused, limit_files
from rosrm.supervisor.spawn_error import ScheduleRefused, SpawnError
from tests.failing_calls import nth_call_fails
from tests.starting import finish

KEY = ("camera", 1)


@pytest.fixture
def confinement(tmp_path: Path) -> Confinement:
    """Return a confinement that has all rights and makes no groups."""
    made = Confinement(str(tmp_path))
    made.groups, made.missing = InstanceGroups(), {}
    return made


def started(_group: int, _scheduler: object) -> int:
    """Pretend to start a process: its pid is one that no process can have."""
    return 2**22 + 1


def not_started(_group: int, _scheduler: object) -> int:
    """Fail the test."""
    raise AssertionError("the process was started")


def test_what_the_host_cannot_enforce_is_left_out(confinement) -> None:
    """The reason is known from the connection to the supervisor, so no note repeats it."""
    confinement.missing = {"limits.memory": "nothing is delegated", "realtime": "no rights"}
    limits = LimitRule(memory=1e8, cpu=1.0, cpus=(min(os.sched_getaffinity(0)),), policy="fifo",
                       priority=1)  # fmt: skip
    assert finish(confinement.start(KEY, limits, started))[1:] == (("limits.cpu", "cpus"), "")


def test_required_limits_that_cannot_be_enforced_refuse_the_start(confinement) -> None:
    """All of them are named, and nothing is started."""
    confinement.missing = dict.fromkeys(
        ("limits.memory", "limits.cpu", "nice"), "nothing is delegated"
    )
    limits = LimitRule(memory=1e8, cpu=1.0, nice=-5, required=True)
    with pytest.raises(SpawnError) as refused:
        finish(confinement.start(KEY, limits, not_started))
    assert not refused.value.transient
    assert str(refused.value) == (
        "its limits are required, and this host cannot enforce limits.memory, limits.cpu and nice: "
        "nothing is delegated"
    )


def test_a_higher_niceness_needs_no_rights(confinement) -> None:
    """A higher niceness is set even where a lower one cannot be."""
    confinement.missing = {"nice": "no rights"}
    assert finish(confinement.start(KEY, LimitRule(nice=5, required=True), started))[1] == ("nice",)
    assert finish(confinement.start(KEY, LimitRule(nice=-5), started))[1] == ()


@pytest.mark.parametrize("required", [True, False])
def test_a_niceness_that_the_kernel_refuses(confinement, required: bool) -> None:
    processes = []

    def start(_group: int, _scheduler: object) -> int:
        processes.append(subprocess.Popen(["sleep", "1000"]))
        return processes[0].pid

    limits = LimitRule(nice=-17, required=required)
    note = f"nice is {os.nice(0)}, because CAP_SYS_NICE is required for -17"
    try:
        if required:
            with pytest.raises(SpawnError, match=note):
                finish(confinement.start(KEY, limits, start))
        else:
            assert finish(confinement.start(KEY, limits, start))[1:] == ((), note)
    finally:
        processes[0].kill()
        processes[0].wait()


@pytest.fixture
def full(tmp_path: Path) -> InstanceGroups:
    """Return groups below a group in which none can be made: a file is in its place."""
    top = tmp_path / "top"
    top.write_text("")
    return InstanceGroups([Tree(1, str(top), str(tmp_path), ("memory",))])


def test_a_group_that_cannot_be_made_is_noted(confinement, full: InstanceGroups) -> None:
    """The process runs without this limit; a process without limits has no note."""
    confinement.groups = full
    pid, enforced, note = finish(confinement.start(KEY, LimitRule(memory=1e8, nice=3), started))
    assert (pid, enforced) == (2**22 + 1, ("nice",))
    assert note.startswith("limits.memory: no control group ")
    assert note.endswith("top/camera.1 can be made: Not a directory")
    assert finish(confinement.start(KEY, LimitRule(), started))[1:] == ((), "")


def test_a_group_that_cannot_be_made_refuses_a_start_that_requires_it(confinement, full) -> None:
    """The master tries another host."""
    confinement.groups = full
    with pytest.raises(SpawnError, match=r"cannot enforce limits\.memory: no control group "):
        finish(confinement.start(KEY, LimitRule(memory=1e8, required=True), not_started))


@pytest.mark.parametrize("call", ["mkdir", "open"])
@pytest.mark.parametrize("ahead", [True, False])
def test_a_shortage_while_a_group_is_made_excludes_no_host(
    confinement, tmp_path, monkeypatch, call, ahead
) -> None:
    """The start is tried again; what was made of the groups is removed with the instance."""
    top = tmp_path / "top"
    top.mkdir()
    confinement.groups = groups = InstanceGroups([Tree(1, str(top), str(tmp_path), ("memory",))])
    limits = LimitRule(memory=1e8, required=True)

    def lack(*_: object, **__: object) -> None:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    with monkeypatch.context() as patched:
        patched.setattr(os, call, lack)
        if ahead:
            confinement.prepare(KEY, limits)
        else:
            with pytest.raises(OSError, match="Cannot allocate memory"):
                finish(confinement.start(KEY, limits, not_started))
    groups.remove(KEY, 0.0)
    assert not list(top.iterdir())


def test_cpus_that_cannot_be_set_for_now_exclude_no_host(confinement, monkeypatch) -> None:
    def lack(*_: object) -> None:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    monkeypatch.setattr(os, "sched_setaffinity", lack)
    limits = LimitRule(cpus=(min(os.sched_getaffinity(0)),))
    with pytest.raises(SpawnError, match="Cannot allocate memory") as failed:
        finish(confinement.start(KEY, limits, not_started))
    assert failed.value.transient


def test_limits_that_change_without_a_group_do_not_hold(confinement, full) -> None:
    """They are refused where they are required."""
    confinement.groups = full
    former, limits = LimitRule(memory=1e8), LimitRule(memory=2e8)
    finish(confinement.start(KEY, former, started))
    assert confinement.change(KEY, former, limits) == ()
    refusal = r"cannot enforce limits\.memory: the instance has no control group for it"
    with pytest.raises(LimitRefused, match=refusal):
        confinement.change(KEY, former, limits._replace(required=True))


def test_a_limit_that_could_not_be_set_at_the_start_is_set_with_the_next_change(
    confinement, tmp_path: Path
) -> None:
    """Otherwise a limit that does not hold would be reported as enforced."""
    group = tmp_path / "top" / "camera.1"
    group.mkdir(parents=True)
    for name in ("cpu.cfs_period_us", "cpu.cfs_quota_us"):
        (group / name).touch()
    tree = Tree(1, str(group.parent), str(tmp_path), ("memory", "cpu"))
    confinement.groups = InstanceGroups([tree])
    former = LimitRule(memory=1e8, cpu=1.0)
    assert list(confinement.groups.make(KEY, former, realtime=False)) == ["limits.memory"]
    (group / "memory.limit_in_bytes").touch()
    changed = confinement.change(KEY, former, former._replace(cpu=2.0))
    assert changed == ("limits.memory", "limits.cpu")
    assert (group / "memory.limit_in_bytes").read_text() == "100000000"


def test_a_group_added_to_a_running_instance_waits_for_no_removal(tmp_path: Path) -> None:
    """Otherwise a group left from the run before would be removed, and its processes killed."""
    trees = [Tree(1, str(tmp_path / name), str(tmp_path), (name,)) for name in ("memory", "cpu")]
    groups, limits = InstanceGroups(trees), LimitRule(cpu=1.0)
    for tree in trees:
        Path(tree.top).mkdir()
    groups.make(KEY, limits, realtime=False)
    left = tmp_path / "cpu" / "camera.1"
    (left / "cgroup.procs").touch()  # the kernel has not released the last process yet
    groups.remove(KEY, 0.0)
    groups.make(KEY, LimitRule(), realtime=False)
    assert groups.deadline() is not None
    groups.add(KEY, limits)
    assert groups.deadline() is None
    assert groups.lacking(KEY, limits) == {}


@pytest.fixture
def unmoved(tmp_path: Path) -> InstanceGroups:
    """Return the groups of an instance with two processes, so far only with a memory group."""
    (tmp_path / "cgroup.procs").touch()
    trees = [Tree(1, str(tmp_path / name), str(tmp_path), (name,)) for name in ("memory", "cpu")]
    groups = InstanceGroups(trees)
    for tree in trees:
        Path(tree.top).mkdir()
    groups.make(KEY, LimitRule(), realtime=False)
    (tmp_path / "memory" / "camera.1" / "cgroup.procs").write_text(f"{2**22 + 1} {2**22 + 2}")
    return groups


def test_a_group_that_no_process_can_be_moved_to_is_removed(unmoved, tmp_path: Path) -> None:
    """The limit is reported as not enforced, and no empty group stays."""
    limits = LimitRule(cpu=1.0)
    unmoved.add(KEY, limits)  # the new directory has no file cgroup.procs
    assert unmoved.lacking(KEY, limits).keys() == {"limits.cpu"}
    assert not (tmp_path / "cpu" / "camera.1").exists()


def test_a_limit_of_only_some_processes_is_not_enforced(unmoved, tmp_path: Path) -> None:
    """A group that lacks a process after the last walk is removed with its instance."""
    group, limits = tmp_path / "cpu" / "camera.1", LimitRule(cpu=1.0)
    group.mkdir()
    (group / "cgroup.procs").touch()  # a plain file: has only the process moved last
    unmoved.add(KEY, limits)
    assert unmoved.lacking(KEY, limits).keys() == {"limits.cpu"}
    (group / "cgroup.procs").unlink()
    unmoved.remove(KEY, 0.0)
    assert not group.exists()


class Closed(InstanceGroups):
    """Groups that can be made, and that no process can enter."""

    def __init__(self, attempts: int) -> None:
        super().__init__()
        self.attempts = attempts

    @contextlib.contextmanager
    def inside(self, key: Key) -> Iterator[int]:
        self.attempts -= 1
        if self.attempts >= 0:
            raise OSError(errno.EINVAL, "Invalid argument")
        yield 7


def in_group(group: int, _scheduler: object) -> int:
    """Return the descriptor of the group as the pid."""
    return group


def test_a_group_that_was_removed_is_made_again(confinement) -> None:
    """Another supervisor may take it for a left-over."""
    confinement.groups = Closed(1)
    assert finish(confinement.start(KEY, LimitRule(memory=1e8), in_group)) == (
        7,
        ("limits.memory",),
        "",
    )


@pytest.mark.parametrize("required", [True, False])
def test_a_group_that_is_made_again_without_its_limits_is_noted(
    confinement, monkeypatch, required: bool
) -> None:
    """Otherwise a limit that does not hold would be reported as enforced."""
    made = [{}, {"limits.memory": "memory.max cannot be written"}]
    confinement.groups = Closed(1)
    monkeypatch.setattr(confinement.groups, "make", lambda *_, **__: made.pop(0))
    limits = LimitRule(memory=1e8, cpu=1.0, required=required)
    if required:
        with pytest.raises(SpawnError, match=r"enforce limits\.memory: memory\.max cannot be"):
            finish(confinement.start(KEY, limits, not_started))
    else:
        note = "limits.memory: memory.max cannot be written"
        assert finish(confinement.start(KEY, limits, in_group)) == (7, ("limits.cpu",), note)


def test_a_group_that_no_process_can_enter_is_left_out(confinement) -> None:
    """The process runs without, unless its limits are required."""
    confinement.groups = Closed(9)
    note = "limits.memory: its control group cannot be entered: Invalid argument"
    assert finish(confinement.start(KEY, LimitRule(memory=1e8), in_group)) == (-1, (), note)
    with pytest.raises(SpawnError, match="cannot be entered: Invalid argument"):
        finish(confinement.start(KEY, LimitRule(memory=1e8, required=True), not_started))


@pytest.mark.parametrize("required", [True, False])
def test_realtime_that_the_kernel_refuses(confinement, required: bool) -> None:
    """Without the requirement the process runs with the default scheduling, and a note."""

    def start(_group: int, scheduler: object) -> int:
        if scheduler is not None:
            raise ScheduleRefused("/bin/x may not have real-time scheduling here")
        return 2**22 + 1

    limits = LimitRule(policy="fifo", priority=40, required=required)
    if required:
        with pytest.raises(SpawnError, match="cannot enforce realtime: /bin/x may not have"):
            finish(confinement.start(KEY, limits, start))
    else:
        note = "realtime: /bin/x may not have real-time scheduling here"
        assert finish(confinement.start(KEY, limits, start)) == (2**22 + 1, (), note)


@pytest.mark.parametrize(
    ("version", "files"),
    [
        (1, {
            "memory.limit_in_bytes": "512000000", "memory.memsw.limit_in_bytes": "512000000",
            "cpu.cfs_period_us": "20000", "cpu.cfs_quota_us": "30000",
        }),
        (2, {
            "memory.max": "512000000", "memory.swap.max": "0", "memory.oom.group": "1",
            "memory.high": "400000000", "cpu.max": "30000 20000",
        }),
    ],
)  # fmt: skip
def test_the_control_files_of_each_version(version: int, files: dict[str, str]) -> None:
    """Swap does not extend a limit, and in version 2 an instance is killed as a whole."""
    limits = LimitRule(memory=512e6, memory_high=4e8, cpu=1.5)
    assert {file: text for _, file, text in limit_files(version, limits)} == files
    assert not list(limit_files(version, LimitRule()))


@pytest.fixture
def files(tmp_path: Path) -> Iterator[tuple[InstanceGroups, Path]]:
    """Return groups of version 2 in plain files, and the folder of one instance."""
    group = tmp_path / "top" / "camera.1"
    groups = InstanceGroups([Tree(2, str(group.parent), str(tmp_path), ("memory", "cpu"))])
    group.mkdir(parents=True)
    (group / "cgroup.procs").write_text("0\n12\n34\n")
    return groups, group


def test_a_process_outside_of_the_pid_namespace_is_left_out(files) -> None:
    """Its pid is 0, and a signal to 0 would reach the supervisor itself."""
    assert instance_groups.pids(str(files[1])) == [12, 34]


def test_kills_of_an_earlier_run_are_not_reported(files) -> None:
    """A group that could not be removed keeps its counters."""
    groups, group = files
    (group / "memory.events").write_text("low 0\noom 2\noom_kill 2\n")
    (group / "memory.peak").write_text("500000000\n")
    (group / "memory.max").write_text("500000000\n")
    (group / "cpu.max").write_text("max 100000\n")
    groups.make(KEY, LimitRule(), realtime=False)
    assert groups.out_of_memory(KEY) is None
    (group / "memory.events").write_text("low 0\noom 3\noom_kill 3\n")
    assert groups.out_of_memory(KEY) == (5e8, 5e8)
    (group / "memory.max").write_text("max\n")
    assert groups.out_of_memory(KEY) == (5e8, 0.0)


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO])
def test_kills_that_cannot_be_counted_before_a_run_are_not_of_the_run(files, number) -> None:
    """A count of 0 would report a kill of an earlier run as one of this run."""
    groups, group = files
    (group / "memory.events").write_text("oom_kill 2\n")
    for n in range(50):
        with nth_call_fails(n, number) as count:
            groups.make(KEY, LimitRule(), realtime=False)
        assert groups.out_of_memory(KEY) is None
        if not count.failed:
            break
    assert 0 < n < 50


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO])
def test_a_limit_below_an_unknown_usage_is_refused(files, number) -> None:
    """Version 2 accepts it, and kills processes of the group."""
    groups, group = files
    (group / "memory.current").write_text("500000000\n")
    (group / "memory.stat").write_text("active_file 0\ninactive_file 0\n")
    groups.make(KEY, LimitRule(), realtime=False)
    for n in range(50):
        (group / "memory.max").write_text("max")
        with nth_call_fails(n, number) as count, pytest.raises(LimitRefused):
            groups.change(KEY, LimitRule(), LimitRule(memory=1e8))
        assert (group / "memory.max").read_text() == "max"
        if not count.failed:
            break
    assert 0 < n < 50


def test_a_group_that_was_made_ahead_gets_changed_limits(tmp_path: Path) -> None:
    """A held instance may be amended before its start; unchanged limits are written only once."""
    top = tmp_path / "top"
    top.mkdir()
    groups = InstanceGroups([Tree(2, str(top), str(tmp_path), ("memory",))])
    group = top / "camera.1"
    groups.prepare(KEY, LimitRule(), realtime=False)
    (group / "memory.max").touch()
    assert groups.make(KEY, LimitRule(), realtime=False) == {}
    assert (group / "memory.max").read_text() == ""
    groups.prepare(KEY, LimitRule(), realtime=False)
    groups.make(KEY, LimitRule(memory=5e8), realtime=False)
    assert (group / "memory.max").read_text() == "500000000"


def test_a_fault_before_the_start_does_not_refuse_the_start(confinement, tmp_path) -> None:
    """Required limits could not be set while the job was held, and can be at its start."""
    top, limits = tmp_path / "top", LimitRule(memory=5e8, required=True)
    top.mkdir()
    confinement.groups = InstanceGroups([Tree(2, str(top), str(tmp_path), ("memory",))])
    confinement.prepare(KEY, limits)  # the control files are missing
    for file in ("memory.max", "memory.oom.group"):
        (top / "camera.1" / file).touch()
    assert finish(confinement.start(KEY, limits, started)).enforced == ("limits.memory",)


def test_an_unlimited_niceness_is_not_missing(tmp_path: Path, monkeypatch) -> None:
    """`ulimit -e unlimited` is -1 to Python."""
    monkeypatch.setattr(group_trees, "_CAP_SYS_NICE", 0)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY,) * 2)
    missing = group_trees.find(str(tmp_path), str(tmp_path)).missing
    assert missing.keys() & {"nice", "realtime"} == set()


def test_the_next_supervisor_knows_the_kills_of_earlier_runs(files) -> None:
    """It reports no kill from before the run, and each kill during the run."""
    before, group = files
    (group / "memory.events").write_text("oom_kill 2\n")
    before.make(KEY, LimitRule(), realtime=False)
    for kills, out_of_memory in [(2, False), (3, True)]:
        (group / "memory.events").write_text(f"oom_kill {kills}\n")
        after = InstanceGroups(before.trees)
        after.find_again({KEY: before.kills_before(KEY)})
        assert (after.out_of_memory(KEY) is not None) is out_of_memory
        assert after.kills_before(KEY) == 2


@pytest.mark.parametrize("number", [errno.ENOMEM, errno.EIO, errno.EACCES])
def test_the_group_of_a_live_instance_that_cannot_be_looked_at_is_no_left_over(
    files, monkeypatch, number: int
) -> None:
    """Otherwise a supervisor that takes over would kill what runs."""
    before, group = files
    left_over = group.with_name("lidar.1")
    (left_over / "inner").mkdir(parents=True)
    killed: list[str] = []
    real = os.stat

    def look(path, *others, **options):
        if os.fspath(path) == str(group):
            raise OSError(number, os.strerror(number))
        return real(path, *others, **options)

    monkeypatch.setattr(os, "stat", look)
    monkeypatch.setattr(instance_groups, "kill", killed.append)
    with pytest.raises(OSError, match=os.strerror(number)):
        InstanceGroups(before.trees).find_again({KEY: 0})
    assert not killed  # the next supervisor begins with all that was there
    monkeypatch.undo()
    monkeypatch.setattr(instance_groups, "kill", killed.append)
    InstanceGroups(before.trees).find_again({KEY: 0})
    assert killed == [str(left_over)]


def test_a_host_without_control_groups_says_so(tmp_path: Path) -> None:
    """Each limit has a reason, which names what is missing."""
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/mountinfo").write_text("")
    found = group_trees.find(str(tmp_path), str(tmp_path))
    assert found.trees == ()
    assert found.missing["limits.cpu"] == "the kernel offers no control group with cpu"
    assert "cgroup_enable=memory" in found.missing["limits.memory"]
    assert found.missing["limits.memory_high"] == found.missing["limits.memory"]


@pytest.fixture
def plain(monkeypatch) -> None:
    """Let groups be made in plain files."""
    monkeypatch.setattr(group_trees, "make_top", lambda tree: Path(tree.top).mkdir())


def recorded_tree(recorded: str, folder: Path, given: str) -> tuple[str, str]:
    """Copy a recorded tree, with the controllers given to groups below; return root and group."""
    root = folder / "root"
    shutil.copytree(Path(__file__).parents[2] / "data/cgroup_v2" / recorded, root)
    (root / "sys/fs/cgroup/cgroup.controllers").write_text("cpuset cpu io memory pids\n")
    (mount,) = cgroups.mounts(str(root))
    own = cgroups.own_group(mount, str(root))
    assert own is not None
    Path(own, "cgroup.subtree_control").write_text(f"{given}\n")
    return str(root), own


def add_mounts(root: str, *lines: bytes) -> None:
    """Add lines to the mounts of a recorded tree."""
    with Path(root, "proc/self/mountinfo").open("ab") as file:
        file.writelines(line + b"\n" for line in lines)


@pytest.mark.parametrize(
    "line",
    [
        b"99 1 8:1 / /media/caf\xe9 rw - ext4 /dev/sdb1 rw",
        b"99 1 8:1 / /media/a\rb rw - ext4 /dev/sdb1 rw",
        b"99 1 8:1 / /media/usb rw",
        b"99 1 - cgroup2",
    ],
)
def test_a_mount_that_cannot_be_read_hides_no_other(line: bytes, tmp_path: Path, plain) -> None:
    """A path may be of any bytes; such a mount ended the slave before it started."""
    root, own = recorded_tree("systemd", tmp_path, "memory cpu")
    before = cgroups.mounts(root)
    add_mounts(root, line)
    assert cgroups.mounts(root) == before
    cgroups.delegate(root)
    assert group_trees.find(str(tmp_path), root).trees[0].home == own


def test_a_group_with_a_name_of_other_bytes_is_used(tmp_path: Path, plain) -> None:
    """The supervisor makes groups below it."""
    root, own = recorded_tree("systemd", tmp_path, "memory cpu")
    other = Path(os.fsdecode(os.fsencode(own) + b"-\xe9"))
    Path(own).rename(other)
    path = Path(root, "proc/self/cgroup")
    path.write_bytes(path.read_bytes().rstrip(b"\n") + b"-\xe9\n")
    assert group_trees.find(str(tmp_path), root).trees[0].home == str(other)


@pytest.mark.parametrize("content", [None, b"", b"nonsense\n", b"0::\n"])
def test_an_own_group_that_cannot_be_read_is_a_reason(content, tmp_path: Path) -> None:
    """The group was read again for the text of the reason, which ended the supervisor."""
    root, _ = recorded_tree("systemd", tmp_path, "memory cpu")
    path = Path(root, "proc/self/cgroup")
    path.unlink() if content is None else path.write_bytes(content)
    cgroups.delegate(root)
    found = group_trees.find(str(tmp_path), root)
    assert found.trees == ()
    assert found.missing["limits.memory"].startswith("no groups can be made below the control ")


def test_a_state_directory_that_is_gone_is_a_reason(tmp_path: Path) -> None:
    """Nothing is enforced, and the supervisor starts."""
    root, _ = recorded_tree("systemd", tmp_path, "memory cpu")
    found = group_trees.find(str(tmp_path / "gone"), root)
    assert "No such file or directory" in found.missing["limits.memory"]


def test_a_group_in_which_no_others_can_be_made_is_removed(tmp_path: Path, monkeypatch) -> None:
    """The group of the supervisor is made for the question only, and nothing would remove it."""
    root, own = recorded_tree("systemd", tmp_path, "memory cpu")

    def refuse(*_: object) -> None:
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(cgroups, "enable", refuse)
    assert "No such device" in group_trees.find(str(tmp_path), root).missing["limits.memory"]
    assert not list(Path(own).glob("rosrm-state-*"))


def test_a_controller_that_is_not_delegated_is_named(tmp_path: Path, plain) -> None:
    """The other one can be used."""
    root, own = recorded_tree("systemd", tmp_path, "memory")
    (tree,), missing = group_trees.find(str(tmp_path), root)
    assert (tree.version, tree.controllers, tree.home) == (2, ("memory",), own)
    assert missing.keys() & {"limits.memory", "limits.memory_high"} == set()
    assert missing["limits.cpu"].startswith(f"the controller cpu is not delegated to {own}. To get")
    assert not list(Path(own).glob("rosrm-state-*"))


@pytest.mark.parametrize("recorded", ["docker", "systemd"])
def test_a_group_that_is_not_delegated_says_how_to_get_it(recorded: str, tmp_path: Path) -> None:
    """A group of version 2 with processes in it gives no controllers to groups below."""
    root, own = recorded_tree(recorded, tmp_path, "")
    found = group_trees.find(str(tmp_path), root)
    assert found.trees == ()
    assert found.missing["limits.memory"] == found.missing["limits.cpu"]
    assert found.missing["limits.cpu"].startswith(
        f"other processes are in the control group {own}, or "
    )
    assert "Delegate=yes" in found.missing["limits.cpu"]
