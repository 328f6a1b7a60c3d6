"""`rosrm logs --archive`: output of hosts that are gone, from a log archive."""

from __future__ import annotations

import stat
import time

import pytest

from rosrm.cli import connection
from rosrm.errors import NoMaster
from tests.unit.archive.rig import HOST, PROCESS, Rig
from tests.unit.cli.conftest import host, process

LINES = b"one\n[ERROR] [1.5] [nav]: battery\nthree\n"


@pytest.fixture
def rig(client, tmp_path):
    """Provide a collected log of a host that is lost."""
    rig = Rig(tmp_path)
    rig.alpha.write(b"hours ago\n", at=time.time() - 7200)
    rig.alpha.write(LINES)
    rig.collect()
    client.hosts = [host(HOST, "lost"), host("beta")]
    client.processes = [process(PROCESS, "unreachable", host=HOST)]
    client.events = []
    client.read_log = rig.master.read_log
    return rig


def test_the_output_of_a_lost_host_is_read_from_the_archive(rosrm, rig):
    """The command prints that the host is gone, and until when its log was collected."""
    result = rosrm("logs", PROCESS, "--archive", str(rig.directory))
    assert (result.code, result.out) == (0, "hours ago\n" + LINES.decode())
    assert "nav: alpha is lost: the master received its last reading" in result.err
    assert f"is read from {rig.directory}, as collected until 20" in result.err
    assert rosrm("logs", PROCESS).code == 1


@pytest.mark.parametrize(
    ("options", "output"),
    [
        (["--tail", "2"], "[ERROR] [1.5] [nav]: battery\nthree\n"),
        (["--since", "1h"], LINES.decode()),
        (["--grep", "batt"], "[ERROR] [1.5] [nav]: battery\n"),
        (["--host", HOST, "--tail", "1"], "three\n"),
    ],
)
def test_options_select_from_the_archive_too(rosrm, rig, options, output):
    assert rosrm("logs", PROCESS, "--archive", str(rig.directory), *options).out == output


def test_older_instances_come_from_the_archive_and_newer_ones_from_their_host(rosrm, client, rig):
    """An instance whose log the slave has removed is only in the archive."""
    client.hosts = [host(HOST)]
    client.processes = [process(PROCESS, host=HOST, number=2)]
    rig.alpha.remove_logs()
    rig.alpha.write(b"now\n", 2)
    out = rosrm("logs", PROCESS, "--archive", str(rig.directory)).out
    lines = [line for line in out.splitlines() if "---" not in line]
    assert lines == ["hours ago", *LINES.decode().splitlines(), "now"]


@pytest.fixture
def no_master(monkeypatch):
    """Let no master answer."""

    def connect(*_):
        raise NoMaster("no master answers in domain 7")

    monkeypatch.setattr(connection, "connect", connect)


def test_without_a_master_the_archive_is_read(rosrm, rig, no_master):
    result = rosrm("logs", PROCESS, "--archive", str(rig.directory), "--tail", "1")
    assert (result.code, result.out) == (0, "three\n")
    assert "only collected logs are printed: no master answers in domain 7\n" in result.err
    assert rosrm("logs", PROCESS).code == 3


def test_without_a_master_an_application_is_not_called_unknown(rosrm, rig, no_master):
    """The archive knows processes only, so the message asks for their names."""
    result = rosrm("logs", "--app", "nav", "--archive", str(rig.directory))
    assert (result.code, "processes in place of --app" in result.err) == (3, True)


def test_a_process_that_master_and_archive_do_not_know_is_refused(rosrm, rig):
    result = rosrm("logs", "unknown", "--archive", str(rig.directory))
    assert (result.code, "no such process: 'unknown'" in result.err) == (1, True)


def test_a_directory_that_is_no_archive_is_refused(rosrm, rig, tmp_path):
    result = rosrm("logs", PROCESS, "--archive", str(tmp_path / "nowhere"))
    assert (result.code, "is no log archive" in result.err) == (1, True)


def test_a_directory_that_cannot_be_looked_into_is_refused(rosrm, rig):
    """The archive may belong to another user."""
    result = rosrm("logs", PROCESS, "--archive", "a" * 300)
    assert (result.code, "cannot be read: File name too long" in result.err) == (1, True)


def test_a_damaged_file_is_named(rosrm, rig):
    rig.alpha.ended.add((PROCESS, 1))
    rig.start()
    rig.collect()
    (file,) = rig.directory.glob("hosts/alpha/*.log.gz")
    file.write_bytes(file.read_bytes()[:-9])
    result = rosrm("logs", PROCESS, "--archive", str(rig.directory))
    assert (result.code, "its log in" in result.err) == (1, True)
    assert "cannot be read" in result.err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--keep", "much"], "--keep: "), (["--keep-host", "1kB"], "--keep-host: "),
        (["--every", "0s"], "--every: "), (["--max-rate", "-1"], "--max-rate: "),
    ],
)  # fmt: skip
def test_a_wrong_option_of_the_collector_is_refused(rosrm, tmp_path, options, message):
    result = rosrm("collect-logs", str(tmp_path / "archive"), *options)
    assert (result.code, message in result.err) == (2, True)
    assert not (tmp_path / "archive").exists()


def test_a_directory_with_other_files_is_refused_and_keeps_its_mode(rosrm, tmp_path):
    """Otherwise it would be closed to its other readers."""
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o755)
    (folder / "file").touch()
    result = rosrm("collect-logs", str(folder))
    assert (result.code, "has other files" in result.err) == (2, True)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o755


def test_a_directory_that_cannot_be_used_is_refused(rosrm, tmp_path):
    (tmp_path / "file").touch()
    result = rosrm("collect-logs", str(tmp_path / "file"))
    assert (result.code, "cannot be used" in result.err) == (2, True)
