"""Table of a slave's sessions, with a written process tree."""

import errno
import os
import shutil

import pytest

from rosrm.model.values import InstanceId
from rosrm.slave.instance_group import InstanceGroup
from rosrm.slave.sessions import SessionTable, SessionUsage
from tests.failing_calls import nth_call_fails
from tests.limits import no_more_files

TICKS = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")


class Tree:
    """A /proc with the processes of a test."""

    def __init__(self, path):
        self.path = path
        self.session = {}

    def put(self, pid, session, *, own=0.0, children=0.0, pages=0, name="sleep"):
        """Add a process: its CPU seconds, those of its reaped children, its pages.

        Half of these pages are shared memory. It also has many pages of files.
        """
        self.session[pid] = session
        fields = [
            "S", 1, pid, session, 0, -1, 0, 0, 0, 0, 0,
            int(own * TICKS), 0, int(children * TICKS), 0, 20, 0, 1, 0, 77, 4096, pages, 0,
        ]  # fmt: skip
        folder = self.path / str(pid)
        folder.mkdir(exist_ok=True)
        (folder / "stat").write_text(f"{pid} ({name}) {' '.join(map(str, fields))}\n")
        kib, shared = PAGE // 1024, pages // 2
        (folder / "status").write_text(
            f"Name:\t{name}\nVmRSS:\t{(pages + 999) * kib} kB\n"
            f"RssAnon:\t{(pages - shared) * kib} kB\n"
            f"RssFile:\t{999 * kib} kB\nRssShmem:\t       {shared * kib} kB\nVmData:\t0 kB\n"
        )

    def end(self, pid):
        """Remove a process that was reaped."""
        del self.session[pid]
        shutil.rmtree(self.path / str(pid))

    def session_of(self, pid):
        try:
            return self.session[pid]
        except KeyError:
            raise ProcessLookupError(pid) from None


@pytest.fixture
def tree(tmp_path):
    return Tree(tmp_path)


@pytest.fixture
def table(tree):
    return SessionTable(tree.path, tree.session_of)


def test_leader_counts_at_once_members_at_the_walk(tree, table):
    """The leader counts once the session is added, other processes from the next walk on."""
    tree.put(10, 10)
    tree.put(11, 10)
    tree.put(12, 12)
    table.add(10)
    assert table.pids() == (10,)
    table.refresh(0.0)
    assert table.pids() == (10, 11)
    assert table.members(10) == (10, 11)
    assert table.members(12) == ()


def test_usage_is_a_mean_between_walks(tree, table):
    """Cores are CPU time over time passed; memory is the sum over all processes.

    Pages of files do not count, because processes share them and the kernel can reclaim them.
    """
    tree.put(10, 10, own=5.0, pages=100)
    tree.put(11, 10, own=1.0, pages=50)
    table.add(10)
    table.refresh(0.0)
    assert table.usage() == {10: SessionUsage(0.0, 150 * PAGE)}
    tree.put(10, 10, own=6.0, pages=100)
    tree.put(11, 10, own=1.5, pages=70)
    table.refresh(1.0)
    assert table.usage() == {10: SessionUsage(pytest.approx(1.5), 170 * PAGE)}


@pytest.mark.parametrize(
    ("parent", "cpu"), [({"own": 1.5, "children": 100.0}, 0.5), ({"own": 1.0}, 0.0)]
)
def test_a_child_that_ends_makes_no_negative_usage_and_no_jump(tree, table, parent, cpu):
    """The time of an ended child is its parent's; the time of an orphan is lost."""
    tree.put(10, 10, own=1.0)
    tree.put(11, 10, own=100.0)
    table.add(10)
    table.refresh(0.0)
    tree.end(11)
    tree.put(10, 10, **parent)
    table.refresh(1.0)
    assert table.usage()[10].cpu == pytest.approx(cpu)


def test_removed_session_is_gone_and_its_time_kept(tree, table):
    """The CPU time of a removed session is kept for good; the others do not change."""
    for leader in (10, 20):
        tree.put(leader, leader, own=1.0)
        table.add(leader)
    table.refresh(0.0)
    table.remove(10, cpu_time=1.25)
    assert table.pids() == (20,)
    assert set(table.usage()) == {20}
    assert table.ended_cpu_time() == 1.25
    table.remove(99, cpu_time=0.5)
    assert table.ended_cpu_time() == 1.75


def test_ended_time_never_falls(table):
    """Invalid values from the kernel or the supervisor do not lower the sum."""
    table.remove(10, cpu_time=2.0)
    table.remove(11, cpu_time=-1.0)
    assert table.ended_cpu_time() == 2.0


def test_process_that_ends_during_the_walk_is_no_error(tree, table):
    """The process was listed a moment earlier. A program may have any name."""
    tree.put(10, 10, pages=10, name="a) S 1 (b c")  # like the end of the name field
    tree.put(11, 10, pages=10)
    table.add(10)
    (tree.path / "11" / "stat").unlink()
    (tree.path / "12").mkdir()  # ended before its session was read
    table.refresh(0.0)
    assert table.usage()[10].memory == 10 * PAGE


def test_without_sessions_nothing_is_walked(table, tmp_path):
    """A slave without processes has no overhead."""
    shutil.rmtree(tmp_path)
    table.refresh(0.0)
    assert (table.pids(), dict(table.usage())) == ((), {})


def test_what_was_handed_out_does_not_change(tree, table):
    """`pids` may be read in another thread while the loop adds and removes."""
    table.add(10)
    before = table.pids()
    table.add(20)
    table.remove(10, 0.0)
    assert before == (10,)


def test_the_node_of_a_component_has_the_pid_of_its_container(tree, table):
    """The process of the component shows that pid in its name; other names mean nothing."""
    for pid, name in ((10, "node in 77"), (20, "node in a box")):
        tree.put(pid, pid)
        (tree.path / str(pid) / "comm").write_text(f"{name}\n")
        table.add(pid)
    assert table.known_as(10) == (10, 77)
    assert table.known_as(20) == (20,)
    assert table.members(10) == (10,), "its usage is not that of the container"


def test_without_descriptors_the_last_usage_stays(tree, table):
    """Usage of 0, and all seconds of a process in the next look, would be wrong readings."""
    tree.put(10, 10, own=5.0, pages=100)
    table.add(10)
    table.refresh(0.0)
    tree.put(10, 10, own=6.0, pages=100)
    with no_more_files():
        table.refresh(1.0)
    assert table.usage() == {10: SessionUsage(0.0, 100 * PAGE)}
    assert table.members(10) == (10,)
    table.refresh(2.0)
    assert table.usage() == {10: SessionUsage(pytest.approx(0.5), 100 * PAGE)}


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO])
@pytest.mark.parametrize("version", [None, 2])
def test_whichever_call_fails_the_usage_is_never_0(tree, table, tmp_path, number, version):
    """A process or group that cannot be read has not ended."""
    tree.put(10, 10, own=5.0, pages=100)
    table.add(10, None if version is None else grouped(tmp_path, version, pids="10\n"))
    table.refresh(0.0)
    before = table.usage()[10].memory
    for n in range(100):
        with nth_call_fails(n, number) as count:
            table.refresh(n + 1.0)
        assert table.usage()[10].memory == before > 0
        if not count.failed:
            break
    assert 2 < n < 100


# --- control groups ---------------------------------------------------------------------------

P = InstanceId("p", 1)
#: Files of a group of each version with 3 CPU seconds, 40 anonymous and 20 shared bytes.
FILES = {
    1: {
        "memory.stat": "cache 999\nrss 1\ntotal_rss 40\ntotal_shmem 20\ntotal_cache 999\n",
        "cpuacct.usage": "3000000000\n",
    },
    2: {"memory.stat": "anon 40\nfile 999\nshmem 20\n", "cpu.stat": "usage_usec 3000000\n"},
}


def grouped(path, version, controllers=("memory", "cpuacct", "cpu"), pids="10\n12\n"):
    """Return the group of the instance, written as files of one version."""
    group = path / f"top{version}" / "p.1"
    group.mkdir(parents=True, exist_ok=True)
    (group / "cgroup.procs").write_text(pids)
    for name, text in FILES[version].items():
        (group / name).write_text(text)
    return InstanceGroup([(version, str(group.parent), controllers)], P)


@pytest.mark.parametrize("version", [1, 2])
def test_the_usage_of_a_group_is_that_of_the_instance(tree, table, tmp_path, version):
    """Each byte counts once, a daemon in a session of its own is a member."""
    tree.put(10, 10, own=7.0, pages=100)
    tree.put(11, 10)  # of the session, and not in the group
    tree.put(12, 12)
    group = grouped(tmp_path, version)
    table.add(10, group)
    table.refresh(0.0)
    assert table.members(10) == (10, 12)
    assert table.usage() == {10: SessionUsage(0.0, 60)}
    file, text = list(FILES[version].items())[1]
    (tmp_path / f"top{version}" / "p.1" / file).write_text(text.replace("3", "4", 1))
    table.refresh(2.0)
    assert table.usage() == {10: SessionUsage(pytest.approx(0.5), 60)}


def test_what_a_group_does_not_measure_is_read_of_its_processes(tree, table, tmp_path):
    """A real-time process has no group of the controller cpu."""
    tree.put(10, 10, own=7.0, pages=100)
    tree.put(12, 12, own=1.0, pages=100)
    group = grouped(tmp_path, 1, ("memory",))
    table.add(10, group)
    table.refresh(0.0)
    tree.put(12, 12, own=2.0, pages=100)
    table.refresh(1.0)
    assert table.usage() == {10: SessionUsage(pytest.approx(1.0), 60)}


def test_sessions_with_and_without_a_group_stand_side_by_side(tree, table, tmp_path):
    """An instance whose group could not be made is measured by its session."""
    for pid, session in ((10, 10), (12, 12), (20, 20), (21, 20)):
        tree.put(pid, session, pages=10)
    table.add(10, grouped(tmp_path, 2))
    table.add(20, InstanceGroup([(2, str(tmp_path / "nowhere"), ("memory",))], P))
    table.refresh(0.0)
    assert (table.members(10), table.members(20)) == ((10, 12), (20, 21))
    assert table.usage() == {10: SessionUsage(0.0, 60), 20: SessionUsage(0.0, 20 * PAGE)}


def test_a_group_that_is_gone_reads_as_its_processes(tree, table, tmp_path):
    """The end of the instance is reported later."""
    tree.put(10, 10, pages=10)
    table.add(10, grouped(tmp_path, 2, pids=""))
    shutil.rmtree(tmp_path / "top2")
    table.refresh(0.0)
    assert table.usage() == {10: SessionUsage(0.0, 10 * PAGE)}
