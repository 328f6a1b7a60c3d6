"""Control groups of a process, and the limits that they set."""

import errno
import os
import shutil
from pathlib import Path

import pytest

from rosrm.errors import ConfigError
from rosrm.testing import FakeClock
from rosrm_resources.cgroups import count_cpus, find_group, lines_of, read_number
from rosrm_resources.cpu import CgroupCpu, CpuOptions
from rosrm_resources.memory import CgroupMemory, MemoryOptions

TREES = Path(__file__).parents[3] / "data" / "cgroup_v2"
RECORDED = sorted(path.name for path in TREES.iterdir() if (path / "proc").is_dir())
MIB = 2.0**20
GIB = 2.0**30


@pytest.fixture
def tree(tmp_path):
    """Copy a recorded tree, so that a test may change it."""

    def copy(name):
        return Path(shutil.copytree(TREES / name, tmp_path / name))

    return copy


def grow_cpu(directory, seconds):
    """Let a group use CPU time."""
    file = directory / "cpu.stat"
    first, rest = file.read_text().split("\n", 1)
    used = int(first.removeprefix("usage_usec ")) + int(seconds * 1e6)
    file.write_text(f"usage_usec {used}\n{rest}")


def test_memory_of_a_container():
    """The container's limit is the capacity; anonymous and shared memory are its usage."""
    gauge = CgroupMemory.find(TREES / "docker")
    assert gauge.capacity == 2 * GIB
    assert gauge.usage() == pytest.approx((450 + 1) * MIB / (2 * GIB))
    gauge.close()


def test_page_cache_is_no_usage(tree):
    """A process that reads large files fills the cache, active or not, and puts no host over."""
    root = tree("docker")
    group = root / "sys/fs/cgroup"
    (group / "memory.current").write_text(f"{2 * GIB}\n")
    stat = "anon 44040192\nshmem 0\ninactive_file 300000000\nactive_file 1700000000\n"
    (group / "memory.stat").write_text(stat)
    gauge = CgroupMemory.find(root)
    assert gauge.usage() == pytest.approx(42 * MIB / (2 * GIB))
    gauge.close()


def test_a_full_machine_leaves_no_room_in_a_group(tree):
    """The limit of a container promises no memory that its machine does not have."""
    root = tree("docker")
    (root / "proc/meminfo").write_text("MemTotal: 16777216 kB\nMemAvailable: 524288 kB\n")
    gauge = CgroupMemory.find(root)
    assert gauge.usage() == pytest.approx(0.75)
    gauge.close()


def test_the_group_of_a_cpu_set_is_measured_where_the_set_begins(tmp_path):
    """The slave's own group below has the same set, but not the processes that use the CPUs."""
    write_proc(tmp_path, "0::/a.service/rosrm-agent\n", "/cg rw - cgroup2 cgroup2 rw")
    (tmp_path / "proc/stat").write_text("cpu 1\n" + "".join(f"cpu{n} 1\n" for n in range(16)))
    service = tmp_path / "cg/a.service"
    for group, cpus in ((service, "0-3"), (service / "rosrm-agent", "0-3"), (tmp_path / "cg", "")):
        group.mkdir(parents=True, exist_ok=True)
        (group / "cpuset.cpus.effective").write_text(f"{cpus or '0-15'}\n")
        (group / "cpu.stat").write_text("usage_usec 0\n")
    clock = FakeClock()
    gauge = CgroupCpu.find(1.0, tmp_path, clock)
    assert gauge.capacity == 4.0
    grow_cpu(service, 4.0)
    clock.advance(1.0)
    assert gauge.usage() == pytest.approx(1.0)
    gauge.close()


def test_cpu_of_a_container(tree):
    """The quota is the capacity, and usage is the time used over time passed."""
    root, clock = tree("docker"), FakeClock()
    gauge = CgroupCpu.find(1.0, root, clock)
    assert gauge.capacity == 1.5
    grow_cpu(root / "sys/fs/cgroup", 0.75)
    clock.advance(1.0)
    assert gauge.usage() == pytest.approx(0.5)
    gauge.close()


def test_least_room_above_counts_for_memory():
    """The tightest limit is the capacity; a fuller group above leaves only its own room."""
    gauge = CgroupMemory.find(TREES / "systemd")
    assert gauge.capacity == 3 * GIB  # memory.high of the service itself
    assert gauge.usage() == pytest.approx(1 - (4096 - 1851) / 3072)  # room in robot.slice
    gauge.close()


def test_least_room_above_counts_for_cpu(tree):
    """Siblings that use up the quota above leave less than the own quota."""
    root, clock = tree("systemd"), FakeClock()
    gauge = CgroupCpu.find(1.0, root, clock)
    assert gauge.capacity == 2.0
    grow_cpu(root / "sys/fs/cgroup/robot.slice", 3.5)
    grow_cpu(root / "sys/fs/cgroup/robot.slice/robot-perception.slice/rosrm.service", 0.2)
    clock.advance(1.0)
    assert gauge.usage() == pytest.approx(0.75)  # 0.5 of 4 cores are left, of 2
    gauge.close()


def test_unlimited_group_is_none():
    """Without any limit the machine's capacity counts."""
    assert CgroupMemory.find(TREES / "unlimited") is None
    assert CgroupCpu.find(1.0, TREES / "unlimited") is None


def test_limit_of_the_whole_machine_is_none(tree):
    """A limit at or above the machine's capacity has no effect."""
    root = tree("docker")
    (root / "sys/fs/cgroup/memory.max").write_text(f"{16 * 2**30}\n")
    (root / "sys/fs/cgroup/cpu.max").write_text("800000 100000\n")
    assert CgroupMemory.find(root) is None
    assert CgroupCpu.find(1.0, root) is None


def test_container_without_a_namespace_of_its_own():
    """If only a part of the hierarchy is mounted, the path of the group starts outside it."""
    root = TREES / "kubernetes"
    assert find_group("memory", root).directory == root / "sys/fs/cgroup"
    assert CgroupMemory.find(root).capacity == GIB


def test_set_of_cpus_is_a_limit():
    """A group that is confined to two CPUs has two cores."""
    assert CgroupCpu.find(1.0, TREES / "kubernetes").capacity == 2.0


def write_proc(root, cgroup, *mounts):
    """Write the control groups of a process and the mounts that it sees."""
    (root / "proc/self").mkdir(parents=True, exist_ok=True)
    (root / "proc/self/cgroup").write_text(cgroup)
    (root / "proc/self/mountinfo").write_text("".join(f"3 1 0:3 / {mount}\n" for mount in mounts))


def test_version_1_beside_version_2(tmp_path):
    """In a hybrid set-up a controller of version 1 is found where it is mounted."""
    write_proc(
        tmp_path, "4:memory:/job\n3:cpu,cpuacct:/\n0::/job\n",
        "/cg/memory\\040v1 rw,relatime - cgroup cgroup rw,memory",
        "/cg/cpu rw,relatime - cgroup cgroup rw,cpu,cpuacct",
        "/cg/unified rw,relatime - cgroup2 cgroup2 rw",
    )  # fmt: skip
    (tmp_path / "cg/memory v1/job").mkdir(parents=True)
    found = find_group("memory", tmp_path)
    assert (found.version, found.directory) == (1, tmp_path / "cg/memory v1/job")
    assert find_group("cpu", tmp_path).version == 1
    assert find_group("io", tmp_path).version == 2


@pytest.mark.parametrize("path", [b"caf\xe9", b"a\rb", b"a\xc2\x85b"])
def test_a_mount_with_any_bytes_in_its_path_is_read(tmp_path, path: bytes):
    """A line ends at a newline alone, which the kernel writes as an escape in a path."""
    write_proc(tmp_path, "0::/\n", "/cg rw - cgroup2 cgroup2 rw")
    with (tmp_path / "proc/self/mountinfo").open("ab") as file:
        file.write(b"4 1 8:1 / /media/%b rw - ext4 /dev/sdb1 rw\n" % path)
    assert find_group("memory", tmp_path).mount == tmp_path / "cg"


def test_memory_of_version_1(tmp_path):
    """Version 1 has other names, and its cache is the total with the groups below."""
    (tmp_path / "memory.usage_in_bytes").write_text("1000000\n")
    (tmp_path / "memory.stat").write_text("inactive_file 7\ntotal_inactive_file 400000\n")
    gauge = CgroupMemory([(tmp_path, 2e6)], version=1)
    assert gauge.usage() == pytest.approx(0.3)
    gauge.close()


def test_need_of_version_1_is_the_total_of_the_group(tmp_path):
    """Anonymous and shared memory of the groups below count; the page cache does not."""
    (tmp_path / "memory.usage_in_bytes").write_text("1000000\n")
    stat = "rss 1\nshmem 1\ntotal_rss 400000\ntotal_shmem 200000\ntotal_active_file 400000\n"
    (tmp_path / "memory.stat").write_text(stat)
    gauge = CgroupMemory([(tmp_path, 2e6)], version=1)
    assert gauge.usage() == pytest.approx(0.3)
    gauge.close()


def test_cpu_of_version_1(tmp_path):
    """Version 1 keeps quota and used time in two controllers, mounted at two places."""
    write_proc(
        tmp_path, "2:cpu:/job\n3:cpuacct:/job\n",
        "/cg/cpu rw - cgroup cgroup rw,cpu", "/cg/acct rw - cgroup cgroup rw,cpuacct",
    )  # fmt: skip
    (tmp_path / "proc/stat").write_text("cpu 1\n" + "".join(f"cpu{n} 1\n" for n in range(4)))
    for place, content in {
        "cpu/job/cpu.cfs_quota_us": "50000\n",
        "cpu/job/cpu.cfs_period_us": "100000\n",
        "cpu/cpu.cfs_quota_us": "-1\n",
        "cpu/cpu.cfs_period_us": "100000\n",
        "acct/job/cpuacct.usage": "0\n",
    }.items():
        file = tmp_path / "cg" / place
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    clock = FakeClock()
    gauge = CgroupCpu.find(1.0, tmp_path, clock)
    assert gauge.capacity == 0.5
    (tmp_path / "cg/acct/job/cpuacct.usage").write_text("100000000\n")
    clock.advance(1.0)
    assert gauge.usage() == pytest.approx(0.2)
    gauge.close()


def test_group_that_cannot_be_seen(tmp_path):
    """A path that does not exist here falls back to the nearest group above."""
    assert find_group("memory", tmp_path) is None  # no control groups at all
    (tmp_path / "cg/a").mkdir(parents=True)
    for path, found in (("/a/gone/b", "cg/a"), ("/../../other", "cg")):
        write_proc(tmp_path, f"0::{path}\n", "/cg rw - cgroup2 cgroup2 rw")
        assert find_group("memory", tmp_path).directory == tmp_path / found


@pytest.mark.parametrize("name", RECORDED)
def test_every_recorded_tree_reads(name):
    """Each recorded tree gives gauges with sane values, or the machine's."""
    for gauge in (CgroupMemory.find(TREES / name), CgroupCpu.find(1.0, TREES / name)):
        if gauge is not None:
            assert gauge.capacity > 0
            assert 0 <= gauge.usage() <= 10
            gauge.close()


@pytest.mark.parametrize(("text", "count"), [("0-3,8", 5), ("0", 1), ("", 0), ("2-3\n", 2)])
def test_counts_cpus(text, count):
    """A list of CPUs as the kernel writes it."""
    assert count_cpus(text) == count


@pytest.mark.parametrize(("text", "number"), [("max", None), ("-1", None), ("", None), ("5 9", 5)])
def test_reads_limits(tmp_path, text, number):
    """The word max and -1 are no limit, nor is an empty or missing file."""
    (tmp_path / "limit").write_text(text)
    assert read_number(tmp_path / "limit") == number
    assert read_number(tmp_path / "missing") is None


def test_another_group_is_measured_instead_of_the_own():
    """The option `group` counts that group and those above it, not the slave's own."""
    gauge = CgroupMemory.find(TREES / "systemd", "/robot.slice")
    assert gauge.capacity == 4 * GIB
    assert gauge.usage() == pytest.approx(1851 / 4096)
    gauge.close()


def test_another_group_that_is_not_there_is_refused():
    """A missing group must not silently become the one above it."""
    with pytest.raises(ConfigError, match=r"no control group '/robot\.slice/jobs' under"):
        CgroupMemory.find(TREES / "systemd", "/robot.slice/jobs")


@pytest.mark.parametrize("options", [MemoryOptions, CpuOptions])
def test_a_group_goes_with_no_other_scope(options):
    """A probe has one scope; the option `group` contradicts any other."""
    with pytest.raises(ValueError, match="goes with the scope 'cgroup', not with 'slice'"):
        options(scope="slice", group="/a")
    with pytest.raises(ValueError, match="does not begin with '/'"):
        options(group="a")


def test_a_limit_that_cannot_be_read_now_is_not_absent(monkeypatch):
    """Otherwise a host without a free descriptor offers what its control group lacks."""

    def refused(*_, **__):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    for read in ("read_text", "read_bytes"):
        monkeypatch.setattr(Path, read, refused)
    for look in (read_number, lines_of):
        with pytest.raises(OSError, match="Too many open files"):
            look(TREES / "docker/proc/self/cgroup")
