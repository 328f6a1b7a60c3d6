"""Requirements of a lab on its machine, checked before anything is made."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from rosrm.errors import LabError
from rosrm_lab import needs
from rosrm_lab.groups import Hierarchy
from rosrm_lab.plan import GIB, MIB, HostPlan, uniform

ALL = sum(1 << bit for bit, _ in needs.CAPABILITIES.values())


def status(effective):
    return f"Name:\tpython\nCapPrm:\t{effective:016x}\nCapEff:\t{effective:016x}\nSeccomp:\t0\n"


@pytest.mark.parametrize("name", needs.CAPABILITIES)
def test_the_missing_right_is_named_and_no_other(name):
    """The error has the purpose of the right; more rights than required are fine."""
    needs.check_rights(status=status(ALL | 1))
    bit, reason = needs.CAPABILITIES[name]
    with pytest.raises(LabError, match=f"missing: {name} {reason}\\. ") as raised:
        needs.check_rights(status=status(ALL & ~(1 << bit)))
    assert sum(other in str(raised.value) for other in needs.CAPABILITIES) == 1


def test_an_ordinary_user_is_told_of_sudo_and_of_slices(monkeypatch):
    """The slices have the requested sizes."""
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    hosts = uniform(3, memory=512 * MIB, cpu=0.5, disk=GIB)
    with pytest.raises(LabError) as raised:
        needs.check_rights(hosts, status(0))
    said = str(raised.value)
    assert "sudo" in said
    assert "{host: host1, scope: slice, budget: {memory: 512MiB, cpu: 0.5, disk: 1024MiB}}" in said


def test_root_of_a_container_is_told_of_privileges(monkeypatch):
    """`sudo` would not help there."""
    monkeypatch.setattr("os.geteuid", lambda: 0)
    with pytest.raises(LabError, match="docker run --privileged"):
        needs.check_rights(status=status(0xA80425FB))  # rights that Docker gives


def test_the_slice_that_is_offered_is_a_good_file(tmp_path):
    """A slave's configuration file can be copied from the advice."""
    from rosrm.config.host import load_host

    with pytest.raises(LabError) as raised:
        needs.check_rights(uniform(1, memory=GIB), status(0))
    line = next(line for line in str(raised.value).splitlines() if ".yaml:  {" in line)
    file = tmp_path / "host1.yaml"
    file.write_text(line.partition(".yaml:")[2].strip())
    assert load_host(file).budget == {"memory": GIB, "cpu": 1.0, "disk": GIB}


@pytest.mark.parametrize("command", needs.COMMANDS)
def test_a_missing_command_is_named_with_its_package(monkeypatch, command):
    """The package is that of Debian and Ubuntu."""
    monkeypatch.setattr("shutil.which", lambda name, path: None)
    package = needs.COMMANDS[command]
    with pytest.raises(LabError, match=f"'{command}' is missing.*apt-get install {package}"):
        needs.find_command(command)


@pytest.mark.parametrize(
    ("machine", "limit", "said"),
    [
        (GIB, None, "1024 MiB are available"),
        (64 * GIB, 2 * GIB, "1024 MiB are available within the limit of this c"),
        (GIB // 2, 2 * GIB, "512 MiB are available on this machine"),
    ],
)
def test_too_little_memory_is_refused(monkeypatch, tmp_path, machine, limit, said):
    """A container has no more memory than its limit leaves, or than the machine."""
    container = [Hierarchy(2, tmp_path, ("memory", "cpu"))] if limit else []
    for name, text in (("max", limit), ("current", GIB), ("stat", "inactive_file 0")):
        (tmp_path / f"memory.{name}").write_text(f"{text}\n")
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=machine))
    monkeypatch.setattr(needs, "find_command", lambda name: name)
    hosts = uniform(3, memory=512 * MIB, disk=16 * MIB)
    with pytest.raises(LabError, match=f"1536 MiB of memory together, and {said}"):
        needs.check_machine(hosts, Path("/"), container)


def test_hosts_without_a_limit_ask_for_no_memory(monkeypatch):
    """They share the memory of the machine."""
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=GIB))
    monkeypatch.setattr(needs, "find_command", lambda name: name)
    monkeypatch.setattr(Path, "exists", lambda path: True)
    needs.check_machine([HostPlan("a", disk=16 * MIB)], Path("/"))


def test_too_little_disk_is_refused(monkeypatch, tmp_path):
    """The folder need not exist yet."""
    monkeypatch.setattr(needs, "find_command", lambda name: name)
    monkeypatch.setattr(needs, "_DEVICE", tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=GIB))
    said = f"2048 MiB together, and 1024 MiB are free under {tmp_path}"
    with pytest.raises(LabError, match=said):
        needs.check_machine(uniform(2), tmp_path / "not" / "there")


def test_a_machine_without_loop_devices_is_told_how_to_get_them(monkeypatch, tmp_path):
    """The disks of the hosts are mounted files."""
    monkeypatch.setattr(needs, "find_command", lambda name: name)
    monkeypatch.setattr(needs, "_DEVICE", tmp_path / "none")
    with pytest.raises(LabError, match=r"no loop devices.*modprobe loop"):
        needs.check_machine(uniform(1), tmp_path)


def test_more_cores_than_there_are_is_only_noted(monkeypatch):
    """Overbooked cores are slow, but allowed."""
    monkeypatch.setattr("psutil.cpu_count", lambda: 2)
    assert needs.overbooked(uniform(4, cpu=0.5)) == ""
    said = "may use 2.5 cores together and this machine has 2"
    assert said in needs.overbooked(uniform(5, cpu=0.5))
