"""CPU, memory and disk of the whole machine."""

import psutil
import pytest

from rosrm_resources.cpu import MachineCpu, machine_cores
from rosrm_resources.disk import FileSystem
from rosrm_resources.memory import MachineMemory


def write_times(proc, *ticks, cores=2):
    """Write a /proc/stat: user nice system idle iowait irq softirq steal guest guest_nice."""
    line = " ".join(map(str, ticks))
    (proc / "stat").write_text(f"cpu  {line}\n" + f"cpu0 {line}\n" * cores + "intr 1 2\n")


def test_cpu_is_all_but_idle_and_waiting(tmp_path):
    """With 100 of 200 ticks idle or waiting for a disk, usage is one half."""
    write_times(tmp_path, 1000, 0, 0, 1000, 0, 0, 0, 0, 0, 0)
    gauge = MachineCpu(1.0, tmp_path)
    assert gauge.capacity == 2.0
    write_times(tmp_path, 1040, 10, 20, 1070, 30, 10, 10, 10, 500, 500)
    assert gauge.usage() == pytest.approx(0.5)
    gauge.close()


def test_first_cpu_reading_of_a_busy_machine_is_not_idle(tmp_path, monkeypatch):
    """Until there are two counts, the load average gives the usage."""
    monkeypatch.setattr("os.getloadavg", lambda: (1.5, 0.0, 0.0))
    write_times(tmp_path, 1000, 0, 0, 1000, 0, 0, 0, 0, 0, 0)
    gauge = MachineCpu(1.0, tmp_path)
    assert gauge.usage() == pytest.approx(0.75)
    gauge.close()


def test_cores_are_those_of_psutil():
    """The number equals an independent count of the same machine."""
    assert machine_cores() == psutil.cpu_count()


def test_memory_is_what_psutil_reads():
    """Two independent readings of the same machine at nearly the same time."""
    gauge = MachineMemory()
    assert gauge.capacity == psutil.virtual_memory().total
    assert gauge.usage() == pytest.approx(psutil.virtual_memory().percent / 100, abs=0.02)
    gauge.close()


def test_disk_is_what_psutil_reads(tmp_path):
    """Two independent readings of the same file system; a path to come counts as its parent's."""
    gauge = FileSystem(tmp_path / "not" / "yet")
    usage = psutil.disk_usage(str(tmp_path))
    assert gauge.usage() == pytest.approx(usage.percent / 100, abs=0.01)
    assert gauge.capacity == pytest.approx(usage.used + usage.free, rel=0.01)


def test_the_cache_of_zfs_is_no_usage(tmp_path):
    """ZFS gives its cache back down to its least size, and MemAvailable does not count it."""
    (tmp_path / "meminfo").write_text("MemTotal: 16000 kB\nMemAvailable: 2000 kB\n")
    stats = tmp_path / "spl/kstat/zfs/arcstats"
    stats.parent.mkdir(parents=True)
    stats.write_text(
        "13 1 0x01 147 39984 5 9\nname type data\nc_min 4 1024000\nsize 4 9216000\nhits 4 5\n"
    )
    gauge = MachineMemory(tmp_path)
    assert gauge.usage() == pytest.approx(1 - (2000 + 8000) / 16000)
    gauge.close()
