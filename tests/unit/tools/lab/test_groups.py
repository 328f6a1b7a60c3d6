"""Control groups of both versions, on recorded trees."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosrm.errors import LabError
from rosrm_lab import groups
from rosrm_lab.groups import Hierarchy, find_hierarchies, limits
from rosrm_lab.plan import GIB, HostPlan

HOST = HostPlan("host1", GIB, 0.5)
V1 = "31 23 0:{n} / /sys/fs/cgroup/{name} rw shared:{n} - cgroup cgroup rw,{name}"
V2 = "30 23 0:26 / /sys/fs/cgroup{at} rw shared:9 - cgroup2 cgroup2 rw,nsdelegate"


def tree(root, *mounts, controllers=None, at=""):
    """Create a machine with these control groups mounted."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/mountinfo").write_text("".join(f"{line}\n" for line in mounts))
    for line in mounts:
        (root / line.split()[4].lstrip("/")).mkdir(parents=True, exist_ok=True)
    if controllers is not None:
        top = root / f"sys/fs/cgroup{at}"
        (top / "cgroup.controllers").write_text(controllers)
        (top / "cgroup.subtree_control").write_text("")
    return root


def test_version_2_has_all_in_one_place(tmp_path):
    """`cpu` keeps the CPU time there, so cpuacct is not missing."""
    root = tree(tmp_path, V2.format(at=""), controllers="cpuset cpu io memory pids")
    assert find_hierarchies(root) == [Hierarchy(2, root / "sys/fs/cgroup", ("memory", "cpu"))]


def test_version_1_has_them_apart(tmp_path):
    """This holds also where two controllers are mounted together."""
    root = tree(tmp_path, V1.format(n=1, name="memory"), V1.format(n=2, name="cpu,cpuacct"))
    assert find_hierarchies(root) == [
        Hierarchy(1, root / "sys/fs/cgroup/memory", ("memory",)),
        Hierarchy(1, root / "sys/fs/cgroup/cpu,cpuacct", ("cpu", "cpuacct")),
    ]


def test_version_1_goes_first_where_both_are_mounted(tmp_path):
    """In a hybrid, version 2 has the controllers that version 1 lacks."""
    lines = [V2.format(at="/unified"), V1.format(n=1, name="memory")]
    root = tree(tmp_path, *lines, controllers="cpu", at="/unified")
    found = {one.version: one.controllers for one in find_hierarchies(root)}
    assert found == {1: ("memory",), 2: ("cpu",)}


@pytest.mark.parametrize(
    ("mounts", "missing"),
    [
        ([], "cpu and cpuacct and memory"),
        ([V1.format(n=1, name="cpu"), V1.format(n=2, name="cpuacct")], "memory"),
    ],
)
def test_a_missing_controller_is_named(tmp_path, mounts, missing):
    """The error also has the way to enable it in a container."""
    with pytest.raises(LabError, match=rf"with {missing} is mounted.*--privileged"):
        find_hierarchies(tree(tmp_path, *mounts))


@pytest.mark.parametrize(
    ("version", "controllers", "expected"),
    [
        (1, ("memory",), {"memory.limit_in_bytes": str(GIB),
                          "memory.memsw.limit_in_bytes": str(GIB)}),
        (1, ("cpu", "cpuacct"), {"cpu.cfs_period_us": "20000", "cpu.cfs_quota_us": "10000"}),
        (2, ("memory", "cpu"), {"memory.max": str(GIB), "memory.swap.max": "0",
                                "cpu.max": "10000 20000"}),
    ],
)  # fmt: skip
def test_limits_of_both_versions(version, controllers, expected):
    """Swap counts as memory; half a core is 10 ms of each 20."""
    found = limits(Hierarchy(version, Path("/m"), controllers), HOST)
    assert list(found) == list(expected.items())


@pytest.mark.parametrize("cpu", [0.01, 0.02, 0.049, 0.05, 0.3, 7.5])
def test_the_kernel_takes_every_quota(cpu):
    """The kernel refuses a quota below 1 ms; the share is as requested."""
    ((_, text),) = limits(Hierarchy(2, Path("/c"), ("cpu",)), HostPlan("a", cpu=cpu))
    quota, period = map(int, text.split())
    assert quota >= 1000
    assert quota / period == pytest.approx(cpu, rel=0.01)


def test_a_host_without_limits_gets_none():
    """No file is written for it."""
    assert not list(limits(Hierarchy(2, Path("/m"), ("memory", "cpu")), HostPlan("a")))


def test_version_2_hands_the_controllers_down_to_the_leaves(tmp_path, monkeypatch):
    """Each group above enables them for those below; the limits are in one leaf."""
    root = tree(tmp_path, V2.format(at=""), controllers="cpu memory")
    real = Path.mkdir

    def make_like_the_kernel(path, *words, **more):
        real(path, *words, **more)
        for name in ("cgroup.subtree_control", "cgroup.procs"):
            if not (path / name).exists():
                (path / name).write_text("")

    monkeypatch.setattr(Path, "mkdir", make_like_the_kernel)
    (hierarchy,) = find_hierarchies(root)
    groups.make([hierarchy], "lab", HOST)

    top = root / "sys/fs/cgroup"
    above = [top, top / "rosrm-lab", top / "rosrm-lab/lab", top / "rosrm-lab/lab/host1"]
    assert [(g / "cgroup.subtree_control").read_text() for g in above] == ["+cpu +memory"] * 4
    limited, free, _ = (above[-1] / leaf for leaf in groups.LEAVES)
    assert (limited / "cpu.max").read_text() == "10000 20000"
    assert (limited / "memory.max").read_text() == str(GIB)
    assert not (free / "memory.max").exists()
    # A slave gives them to the groups of its processes, so its own group is below this one.
    assert (limited / "cgroup.subtree_control").read_text() == "+cpu +memory"
    agents = limited / "rosrm-agent"
    assert groups.doors([hierarchy], "lab", "host1", "limited") == [agents / "cgroup.procs"]
    assert not (agents / "cgroup.subtree_control").read_text()  # this group has processes


def test_a_top_group_that_another_lab_removes_is_made_again(tmp_path, monkeypatch):
    """The removal of the last other lab deletes the top group before this lab has a group in it."""
    hierarchy = Hierarchy(1, tmp_path, ("memory",))
    real, removals = Path.mkdir, []

    def mkdir(path, *words, **more):
        if path == hierarchy.top / "lab" and not removals:
            removals.append(path)
            hierarchy.top.rmdir()
        real(path, *words, **more)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    groups.make([hierarchy], "lab", HostPlan("host1"))
    assert removals
    assert all(hierarchy.group("lab", "host1", leaf).is_dir() for leaf in groups.LEAVES)


def test_a_group_that_holds_processes_is_explained(tmp_path, monkeypatch):
    """In a container of version 2 the top group holds the container's processes."""
    root = tree(tmp_path, V2.format(at=""), controllers="cpu memory")
    (hierarchy,) = find_hierarchies(root)

    def busy(path, text):
        raise OSError(16, "Device or resource busy", str(path))

    monkeypatch.setattr(Path, "write_text", busy)
    with pytest.raises(LabError, match="a group with processes in it hands nothing on"):
        groups.make([hierarchy], "lab", HOST)


def test_memory_in_use_is_without_cache(tmp_path):
    """The value equals the probe's."""
    group = tmp_path / "rosrm-lab/lab/host1/limited"
    group.mkdir(parents=True)
    (group / "memory.current").write_text("1000\n")
    (group / "memory.stat").write_text("anon 1\ninactive_file 300\nactive_file 5\n")
    hierarchy = Hierarchy(2, tmp_path, ("memory",))
    assert groups.memory_used([hierarchy], "lab", "host1") == 700
    assert groups.memory_used([hierarchy], "lab", "other") is None


@pytest.mark.parametrize(
    ("version", "files", "left"),
    [
        (2, {"max": "1000", "current": "300", "stat": "inactive_file 50"}, 750),
        (2, {"max": "1000", "current": "1300", "stat": ""}, 0),
        (2, {"max": "max", "current": "300", "stat": ""}, None),
        (2, {}, None),
        (1, {"limit_in_bytes": "1000", "usage_in_bytes": "300",
             "stat": "inactive_file 1\ntotal_inactive_file 50"}, 750),
    ],
)  # fmt: skip
def test_what_a_container_may_still_use(tmp_path, version, files, left):
    """The result is the limit less the usage; the machine's own group of version 2 has no limit."""
    for name, content in files.items():
        (tmp_path / f"memory.{name}").write_text(f"{content}\n")
    cpu = Hierarchy(1, tmp_path / "cpu", ("cpu",))
    assert groups.memory_left([cpu, Hierarchy(version, tmp_path, ("memory",))]) == left
