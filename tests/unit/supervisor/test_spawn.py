"""Starts of processes that cannot work; the supervisor survives each of them."""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import sys

import pytest

from rosrm.supervisor.spawn import Program, begin, find_executable
from rosrm.supervisor.spawn_error import TRANSIENT, SpawnError
from tests.faults.disks import small_disk
from tests.starting import executed


@pytest.mark.parametrize(
    ("argv", "environment", "directory", "said"),
    [
        (("true",), {"PATH": "/bin"}, "/no/such", "working directory '/no/such' cannot be entered"),
        (("true",), {"PATH": "/bin"}, "/tmp/\0", "working directory .* cannot be entered"),
        (("true",), {"PATH": "/bin"}, "/\ud800", "working directory .* cannot be entered"),
        (("/no/such",), {}, "/", "no executable '/no/such' exists"),
        (("true", "\0"), {"PATH": "/bin"}, "/", "'true' cannot be started: embedded null"),
        (("true", "\ud800"), {"PATH": "/bin"}, "/", "'true' cannot be started: .* encode"),
    ],
)
def test_an_impossible_start_is_explained(argv, environment, directory, said):
    null = os.open(os.devnull, os.O_RDWR)
    try:
        with pytest.raises(SpawnError, match=said):
            executed(begin(Program(argv, environment, directory), null, null))
    finally:
        os.close(null)


def test_a_program_that_was_removed_is_searched_for_again(tmp_path):
    """A path that was found a moment ago is not returned if nothing is there any more."""
    places = [tmp_path / "first", tmp_path / "second"]
    for place in places:
        place.mkdir()
        (place / "tool").touch(0o700)
    environment = {"PATH": f"{places[0]}:{places[1]}"}
    assert find_executable("tool", environment) == str(places[0] / "tool")
    (places[0] / "tool").unlink()
    assert find_executable("tool", environment) == str(places[1] / "tool")


def elf(machine: int, loader: bytes = b"") -> bytes:
    """Return an ELF file for 64 bits and a machine, with a loader."""
    head = b"\x7fELF\2\1\1".ljust(16, b"\0") + struct.pack("<HHIQQQIHHHHHH", 2, machine, 1, 0x78,
        64, 0, 0, 64, 56, 1, 0, 0, 0)  # fmt: skip
    at, size = 120, len(loader) + 1
    part = struct.pack("<IIQQQQQQ", 3, 4, at, at, at, size, size, 1)
    return head + part + loader + b"\0"


OTHER, OWN = (183, 62) if os.uname().machine == "x86_64" else (62, 183)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (elf(OTHER), "a program for (aarch64|x86_64), and this host is"),
        (elf(OWN, b"/lib/ld-none.so.1"), "its loader does not exist on this host: '/lib/ld-none"),
        (b"#!/no/such/python -u\n", "the interpreter in its first line does not exist: '/no/such/"),
        (b"#!/bin/sh\r\n", r"does not exist: '/bin/sh\\r'; the line ends with a carriage return"),
        (b"#!\n", "its first line, #!, names no interpreter"),
        (b"#!/etc/passwd\n", "the interpreter in its first line is not executable: '/etc/passwd'"),
        (b"echo\n", "neither a program nor a script with #!"),
        (b"", r"neither a program nor a script with #! \(it is empty\)"),
        (b"\x7fELF\2\1\1", "damaged"),
        (None, "it is a directory"),
    ],
)
def test_the_reason_of_a_failed_exec_is_read_from_the_file(tmp_path, content, said):
    """The error number alone is the same for a missing loader and a missing interpreter."""
    path = tmp_path / "program"
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
        path.chmod(0o755)
    with pytest.raises(SpawnError, match=said):
        executed(begin(Program((str(path),), {}, "/"), 0, 1))


def test_a_program_without_its_permission_or_target_is_said(tmp_path):
    """A file without x, a FIFO and a link to nothing have reasons of their own."""
    plain, fifo, link = tmp_path / "plain", tmp_path / "fifo", tmp_path / "link"
    plain.write_text("#!/bin/sh\n")
    os.mkfifo(fifo, 0o755)
    link.symlink_to("nowhere")
    said = {
        plain: "not executable .`chmod",
        fifo: "no regular file",
        link: "is a link to 'nowhere'",
    }
    for path, reason in said.items():
        with pytest.raises(SpawnError, match=reason):
            executed(begin(Program((str(path),), {}, "/"), 0, 1))


def test_a_program_on_a_mount_without_exec_is_said(tmp_path):
    """The mode of the file permits its execution, so the mount is the reason."""
    with small_disk(tmp_path / "disk", "noexec") as disk:
        program = disk.place / "program"
        program.write_text("#!/bin/sh\n")
        program.chmod(0o755)
        with pytest.raises(SpawnError, match="mounted with noexec"):
            executed(begin(Program((str(program),), {}, "/"), 0, 1))


def test_a_start_ends_with_its_supervisor(tmp_path, monkeypatch):
    """The next supervisor does not find it before its exec, and may start the same once more."""
    null = os.open(os.devnull, os.O_RDWR)
    monkeypatch.setattr(os, "getppid", lambda: 1)  # of the child, whose parent is gone
    pid = executed(begin(Program(("touch", "ran"), dict(os.environ), str(tmp_path)), null, null))
    os.close(null)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 127
    assert not (tmp_path / "ran").exists()


def refuse(monkeypatch, module, name: str, number: int, about: str) -> None:
    """Let a call fail with an error, where its first argument ends with a text."""
    real = getattr(module, name)

    def call(first, *others, **options):
        if isinstance(first, str) and first.endswith(about):
            raise OSError(number, os.strerror(number))
        return real(first, *others, **options)

    monkeypatch.setattr(module, name, call)


SHORTAGES = sorted(TRANSIENT - {errno.ETXTBSY})
#: Call that a start makes, and the end of the path that the call is about.
CALLS = {"chdir": "/place", "open": "/secret", "stat": "/tool", "execve": "/tool"}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("number", SHORTAGES, ids=errno.errorcode.get)
def test_a_shortage_fails_the_attempt_and_not_the_host(tmp_path, monkeypatch, call, number):
    """Otherwise the host counts as one that cannot start the process, for good."""
    place, secret, tool = tmp_path / "place", tmp_path / "secret", tmp_path / "tool"
    place.mkdir()
    secret.write_text("x")
    tool.write_text("#!/bin/sh\n")
    tool.chmod(0o700)
    program = Program(("tool",), {"PATH": str(tmp_path)}, str(place), {"TOKEN": str(secret)})
    refuse(monkeypatch, os, call, number, CALLS[call])
    with pytest.raises(SpawnError, match=os.strerror(number)) as failed:
        executed(begin(program, 0, 1))
    assert failed.value.transient


@pytest.mark.parametrize("call", CALLS)
def test_a_denied_path_is_a_verdict_about_the_host(tmp_path, monkeypatch, call):
    (tmp_path / "place").mkdir()
    (tmp_path / "secret").write_text("x")
    (tmp_path / "tool").touch(0o700)
    environment, secrets = {"PATH": str(tmp_path)}, {"TOKEN": str(tmp_path / "secret")}
    program = Program(("tool",), environment, str(tmp_path / "place"), secrets)
    refuse(monkeypatch, os, call, errno.EACCES, CALLS[call])
    with pytest.raises(SpawnError) as failed:
        executed(begin(program, 0, 1))
    assert not failed.value.transient


def test_a_shortage_on_the_path_chooses_no_other_program(tmp_path, monkeypatch):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "tool").touch(0o700)
    refuse(monkeypatch, os, "stat", errno.ENOMEM, "first/tool")
    with pytest.raises(SpawnError, match="Cannot allocate memory") as failed:
        find_executable("tool", {"PATH": f"{tmp_path}/first:{tmp_path}/second"})
    assert failed.value.transient


def test_a_directory_of_the_path_on_a_broken_disk_hides_no_other(tmp_path, monkeypatch):
    """A program that is in none of the others may be there, so the host is not excluded."""
    (tmp_path / "tool").touch(0o700)
    refuse(monkeypatch, os, "stat", errno.EIO, "broken/tool")
    path = f"/broken:{tmp_path}"
    assert find_executable("tool", {"PATH": path}) == str(tmp_path / "tool")
    (tmp_path / "tool").unlink()
    with pytest.raises(SpawnError, match=r"/broken/tool.*Input/output error") as failed:
        find_executable("tool", {"PATH": path})
    assert failed.value.transient


@pytest.mark.parametrize(
    ("fault", "transient"),
    [
        (OSError(errno.ENOMEM, "no memory"), True),
        (MemoryError(), True),
        (OSError(errno.EINVAL, "invalid"), False),
        (ValueError("odd"), False),
    ],
)
def test_any_other_fault_in_the_child_is_judged_alike(monkeypatch, fault, transient):
    def fail(*_):
        raise fault

    monkeypatch.setattr(os, "closerange", fail)
    with pytest.raises(SpawnError, match="'true' cannot be started") as failed:
        executed(begin(Program(("true",), {"PATH": "/bin"}, "/"), 0, 1))
    assert failed.value.transient is transient


#: A supervisor whose child can open no file any more, from just before its exec on.
WITHOUT_FILES = """
import os, resource
from rosrm.supervisor import spawn
execute = os.execve
def short_of_files(*arguments):
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    execute(*arguments)
os.execve = short_of_files
attempt = spawn.begin(spawn.Program(("/no/such",), {}, "/"), 0, 1)
os.waitpid(attempt.pid, 0)
attempt.read()
try:
    attempt.check()
except spawn.SpawnError as error:
    print(error, error.transient)
"""


def test_a_child_without_descriptors_can_still_name_its_fault():
    """A module that the child had to load would fail with the shortage, and hide the fault."""
    command = [sys.executable, "-c", WITHOUT_FILES]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said == "no executable '/no/such' exists False\n"


def test_a_file_on_the_path_that_may_not_be_executed_is_said(tmp_path):
    (tmp_path / "tool").touch(0o600)
    with pytest.raises(SpawnError, match="/tool cannot be started: it is not executable"):
        executed(begin(Program(("tool",), {"PATH": str(tmp_path)}, "/"), 0, 1))
