"""Secrets: real processes of a real supervisor get them, and nothing stores them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rosrm.core.supervisor.events import RestartOrdered
from rosrm.model.values import InstanceState
from tests.waiting import wait_until

#: Prints only that the secret has arrived, not the secret.
SHOW = "import os, time; print(len(os.environ['TOKEN']), flush=True); time.sleep(1000)"


def secret_of(pid: int) -> bytes:
    """Return the value of TOKEN in the environment of a process.

    The parent of a new process can continue before the kernel lets others read the environment.
    """
    environment = Path(f"/proc/{pid}/environ")
    variables = wait_until(environment.read_bytes, f"the environment of {pid}").split(b"\0")
    return next(one.removeprefix(b"TOKEN=") for one in variables if one.startswith(b"TOKEN="))


def files_with(directory: Path, text: bytes) -> list[Path]:
    """Return the files below a directory that contain a text."""
    return [one for one in directory.rglob("*") if one.is_file() and text in one.read_bytes()]


@pytest.fixture
def token(tmp_path) -> Path:
    path = tmp_path / "token"
    path.write_bytes(b"hush-1\n")
    path.chmod(0o600)
    return path


def test_each_start_reads_the_file_again(host, client, token) -> None:
    """A restart takes a rotated secret, also after the supervisor was killed and replaced."""
    order = host.python("robot", SHOW, environment={"TOKEN": "?"}, secrets={"TOKEN": str(token)})
    client.start([order])
    assert secret_of(host.running(client, "robot").pid) == b"hush-1"

    token.write_bytes(b"hush-2\n\n")
    client.send(RestartOrdered(("robot", 1)))
    assert secret_of(host.running(client, "robot").pid) == b"hush-2\n"

    token.write_bytes(b"\xffhush-3")
    successor = host.replace_supervisor(client)
    successor.send(RestartOrdered(("robot", 1)))
    assert secret_of(host.running(successor, "robot").pid) == b"\xffhush-3"


def test_no_file_of_the_supervisor_holds_the_value(host, client, token) -> None:
    """Its record names the file of the secret, so a later supervisor can read it, too."""
    order = host.python("robot", SHOW, secrets={"TOKEN": str(token)})
    client.start([order])
    pid = host.running(client, "robot").pid
    host.replace_supervisor(client)
    assert secret_of(pid) == b"hush-1"
    assert files_with(host.state, str(token).encode()) == [host.state / "instances.jsonl"]
    assert not files_with(host.state, b"hush-1")


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: None, "cannot be read: {}: No such file or directory"),
        (lambda path: path.mkdir(), "cannot be read: {}: Is a directory"),
        (os.mkfifo, "cannot be read: {} is not a regular file"),
        (lambda path: path.write_bytes(b"x" * 65537), "in {} has more than 64 KiB"),
        (lambda path: path.write_bytes(b"x\0y"), "in {} has a NUL byte"),
    ],
)
def test_a_host_refuses_a_process_whose_secret_cannot_be_read(
    host, client, tmp_path, make, reason
) -> None:
    """The reason names variable and file, and quotes nothing of the file."""
    path = tmp_path / "odd"
    make(path)
    final = host.run(client, host.order("robot", "true", secrets={"TOKEN": str(path)}))
    assert final.state is InstanceState.REFUSED
    assert f"the secret TOKEN {reason.format(repr(str(path)))}" in final.message
    assert "xx" not in final.message
