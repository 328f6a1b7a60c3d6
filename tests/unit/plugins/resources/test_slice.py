"""CPU, memory and disk of a slice: the slave's own process tree against a budget."""

import errno
import os
import shutil
from pathlib import Path

import pytest

from rosrm.errors import ConfigError
from rosrm.testing import FakeClock, FakeSessions, probe_context
from rosrm_resources import cpu, disk, memory
from rosrm_resources.cpu import SliceCpu
from rosrm_resources.disk import DirectoryTree, tree_bytes, writes_to
from rosrm_resources.files import ProcessFiles
from rosrm_resources.memory import SliceMemory
from tests.failing_calls import nth_call_fails

TICKS = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")


class Tree:
    """A /proc with the processes of a test."""

    def __init__(self, path, cores=4):
        self.path = path
        cpus = "".join(f"cpu{n} 0 0 0 0\n" for n in range(cores))
        (path / "stat").write_text(f"cpu 0 0 0 0\n{cpus}")
        self.put("self", 1, own=0.0, started=1000)

    def put(self, pid, session, own, children=0.0, pages=0, started=2000):
        folder = self.path / str(pid)
        folder.mkdir(exist_ok=True)
        ticks = f"{round(own * TICKS)} 0 {round(children * TICKS)} 0"
        (folder / "stat").write_text(
            f"{pid} (a) b) S 1 {pid} {session} 0 -1 0 0 0 0 0 {ticks} 20 0 1 0 {started} 0 0\n"
        )
        (folder / "statm").write_text(f"9999 {pages} 10 1 0 50 0\n")
        shared, own = pages // 10 * PAGE // 1024, (pages - pages // 10) * PAGE // 1024
        (folder / "status").write_text(
            f"Name:\ta\nVmRSS:\t999999 kB\nRssAnon:\t{own} kB\nRssFile:\t999 kB\n"
            f"RssShmem:\t{shared} kB\n"
        )

    def end(self, pid):
        # An open file must answer as in the kernel: with no content.
        for file in (self.path / str(pid)).iterdir():
            file.write_text("")
        shutil.rmtree(self.path / str(pid))


@pytest.fixture
def tree(tmp_path):
    return Tree(tmp_path)


class Gauge:
    """CPU gauge of a slice of two cores, read ten times a second."""

    def __init__(self, tree, *pids):
        self.clock = FakeClock()
        self.sessions = FakeSessions(pids)
        self.gauge = SliceCpu(2.0, self.sessions, 1.0, tree.path, self.clock)

    def after(self, seconds=0.1):
        self.clock.advance(seconds)
        return self.gauge.usage()


def test_cpu_is_time_over_budget(tree):
    """One busy process uses half of a budget of two cores."""
    tree.put(10, 10, own=50.0)
    gauge = Gauge(tree, 10)
    tree.put(10, 10, own=50.1)
    assert gauge.after() == pytest.approx(0.5)


def test_cpu_of_a_budget_can_be_exceeded(tree):
    """A budget is not enforced: usage above the budget is above 1."""
    tree.put(10, 10, own=0.0)
    gauge = Gauge(tree, 10)
    tree.put(10, 10, own=0.4)
    assert gauge.after() == pytest.approx(2.0)


def test_cpu_of_a_waited_for_child_counts_once(tree):
    """The child's time moves into its parent's time, without a gap or a jump."""
    tree.put(10, 10, own=0.0)
    tree.put(11, 10, own=30.0)
    gauge = Gauge(tree, 10, 11)
    tree.end(11)
    tree.put(10, 10, own=0.0, children=30.1)
    assert gauge.after() == pytest.approx(0.5)


def test_cpu_of_an_ended_session_counts_once(tree):
    """The last known time counts between the session's end and the report of it."""
    tree.put(10, 10, own=60.0)
    gauge = Gauge(tree, 10)
    tree.put(10, 10, own=60.2)
    gauge.after()
    tree.end(10)
    assert gauge.after() == pytest.approx(0.5)
    gauge.sessions.members, gauge.sessions.ended = (), 60.2
    assert gauge.after() == pytest.approx(0.2 / 0.3 / 2)
    assert gauge.after(2.0) < 0.1


def test_cpu_of_processes_too_short_to_be_seen_counts(tree):
    """A process that began and ended between two reads counts in the time of ended sessions."""
    gauge = Gauge(tree)
    gauge.sessions.ended = 0.1
    assert gauge.after() == pytest.approx(0.5)


def test_cpu_of_a_process_taken_over_is_no_burst(tree):
    """An hour of CPU time of a re-adopted process is no present load."""
    gauge = Gauge(tree)
    tree.put(10, 10, own=3600.0, started=999)
    gauge.sessions.members = (10,)
    assert gauge.after() == 0.0
    tree.put(10, 10, own=3600.1, started=999)
    assert gauge.after() == pytest.approx(0.1 / 0.2 / 2)
    tree.end(10)
    gauge.sessions.members, gauge.sessions.ended = (), 3600.1
    assert gauge.after() == pytest.approx(0.1 / 0.3 / 2)


def test_cpu_of_a_process_that_is_found_late_is_bounded(tree):
    """A session seen late counts at most as much as four cores can use in that time."""
    gauge = Gauge(tree)
    tree.put(10, 10, own=3600.0)
    gauge.sessions.members = (10,)
    assert 0.0 < gauge.after(0.1) <= 4 * 1.2 / 0.1 / 2
    for _ in range(15):
        usage = gauge.after()
    assert usage == pytest.approx(0.0)


def test_orphan_that_ends_leaves_no_gap(tree):
    """The orphan's time is lost, but usage by others counts at once."""
    tree.put(10, 10, own=0.0)
    tree.put(11, 10, own=30.0)
    gauge = Gauge(tree, 10, 11)
    tree.end(11)
    assert gauge.after() == 0.0
    tree.put(10, 10, own=0.2)
    assert gauge.after() == pytest.approx(0.5)  # 0.2 s in 0.2 s, of two cores


def test_memory_is_the_sum_of_the_known_processes(tree):
    """Usage is anonymous and shared memory over the budget, as `rosrm ps` shows it."""
    tree.put(10, 10, 0.0, pages=100)
    tree.put(11, 10, 0.0, pages=50)
    sessions = FakeSessions((10, 11, 12))
    gauge = SliceMemory(1000.0 * PAGE, sessions, tree.path)
    assert gauge.usage() == pytest.approx(0.15)
    tree.end(11)
    assert gauge.usage() == pytest.approx(0.1)
    sessions.members = ()
    assert gauge.usage() == 0.0
    gauge.close()


def test_files_of_many_processes_are_not_all_kept_open(tree):
    """A slave with hundreds of processes stays far from the limit of open files."""
    pids = tuple(range(100, 500))
    for pid in pids:
        tree.put(pid, pid, 0.0, pages=1)
    before = open_files()
    files = ProcessFiles(tree.path, "statm")
    assert len(list(files.read(pids))) == 400
    assert len(list(files.read(pids))) == 400
    assert open_files() - before <= 128
    assert len(list(files.read(pids[:3]))) == 3
    assert open_files() - before == 3
    files.close()
    assert open_files() == before


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize(
    ("module", "options", "resource"),
    [(cpu, cpu.CpuOptions(), "cpu"), (memory, memory.MemoryOptions(), "memory")],
)
def test_slice_without_a_budget_is_refused(module, options, resource):
    """The error has the missing budget, its unit and the available amount."""
    with pytest.raises(ConfigError, match=f"needs a budget for '{resource}' in .*: disk"):
        module.create(options, probe_context("slice", budget={"disk": 1.0}))
    with pytest.raises(ConfigError, match="must be above 0"):
        module.create(options, probe_context("slice", budget={resource: 0.0}))


def test_option_overrides_the_hosts_scope():
    """One probe may measure the machine on a host that is a slice."""
    probe = memory.create(memory.MemoryOptions(scope="machine"), probe_context("slice"))
    assert probe.resources[0].scope == "machine"
    probe.close()


def test_usage_far_over_a_budget_is_bounded(tmp_path):
    """The master refuses huge values; ten times the budget is informative enough."""
    (tmp_path / "log").write_bytes(b"x" * 100_000)
    context = probe_context("slice", budget={"disk": 1.0}, data_directory=tmp_path)
    probe = disk.create(disk.DiskOptions(), context)
    assert probe.read()[0].usage == 10.0


def test_disk_of_a_slice_is_what_lies_below_its_directory(tmp_path):
    """All files count by the blocks they take; links are not followed; hidden ones count."""
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/.hidden").write_bytes(b"x" * 100_000)
    (tmp_path / "a/log").write_bytes(b"x" * 50_000)
    (tmp_path / "away").symlink_to("/usr")
    assert 150_000 <= tree_bytes(str(tmp_path)) < 200_000
    assert tree_bytes(str(tmp_path / "missing")) == 0


def test_disk_of_a_slice_is_walked_seldom(tmp_path):
    """The last result counts until the next walk."""
    clock = FakeClock()
    gauge = DirectoryTree(tmp_path, 1e6, 5.0, clock)
    assert gauge.usage() == 0.0
    (tmp_path / "log").write_bytes(b"x" * 500_000)
    clock.advance(4.9)
    assert gauge.usage() == 0.0
    clock.advance(0.2)
    assert gauge.usage() == pytest.approx(0.5, rel=0.1)


def test_long_walk_makes_the_next_wait(tmp_path, monkeypatch):
    """The walk of a directory of a million files takes at most a hundredth of the time."""
    clock = FakeClock()
    walks = []

    def walk(path):
        walks.append(path)
        clock.advance(2.0)
        return 0

    monkeypatch.setattr(disk, "tree_bytes", walk)
    gauge = DirectoryTree(tmp_path, 1e6, 5.0, clock)
    for _ in range(100):
        gauge.usage()
        clock.advance(1.9)
    assert len(walks) == 1
    clock.advance(10.0)
    gauge.usage()
    assert len(walks) == 2


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO, errno.ESTALE])
def test_disk_of_a_slice_is_unknown_after_any_call_that_fails(tmp_path, number):
    """A part that cannot be looked at is not empty; the next walk looks again."""
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/file").write_bytes(b"x" * 10_000)
    size, now = float(tree_bytes(str(tmp_path))), [0.0]
    for n in range(20):
        tree = DirectoryTree(tmp_path, size, clock=lambda: now[0])
        with nth_call_fails(n, number) as count:
            seen = usage_of(tree)
        if not count.failed:
            break
        assert seen is None
        assert usage_of(tree) is None  # there was no other walk
        now[0] += 5.0
        assert usage_of(tree) == 1.0
    assert 5 <= n < 20


def usage_of(tree: DirectoryTree) -> float | None:
    try:
        return tree.usage()
    except OSError:
        return None


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO, errno.ESTALE])
def test_a_writer_is_not_left_out_by_a_call_that_fails(tmp_path, number):
    device, before = disk.device_of(tmp_path), disk.written_bytes(os.getpid())
    with (tmp_path / "open").open("w"):
        for n in range(1000):
            try:
                with nth_call_fails(n, number) as count:
                    amount, writes = disk.written_bytes(os.getpid()), writes_to(os.getpid(), device)
            except OSError:
                continue
            assert (amount >= before, writes) == (True, True)
            break
    assert not count.failed


def test_disk_without_a_budget_is_the_file_system(tmp_path):
    """A slice without a disk budget shares the disk, so the whole disk counts."""
    context = probe_context("slice", data_directory=tmp_path / "not" / "yet")
    probe = disk.create(disk.DiskOptions(), context)
    assert probe.resources[0].scope == "machine"
    assert 0.0 < probe.read()[0].usage < 1.0
