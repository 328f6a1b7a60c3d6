"""Files of an instance: each of its runs finds them as they were ordered."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rosrm.model.values import RestartPolicy
from rosrm.supervisor.instance_files import provide
from rosrm.supervisor.spawn_error import SpawnError
from tests.faults.disks import small_disk
from tests.waiting import wait_until

ALWAYS = RestartPolicy("always", delay=0.01)
CONTENT = "rate: 10\n"


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def zeros(path: Path) -> None:
    path.write_bytes(bytes(len(CONTENT)))


def older(path: Path) -> None:
    path.write_text("rate: 9\n")


def linked(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/null")


@pytest.mark.parametrize("damage", [emptied, zeros, older, Path.unlink, linked])
def test_a_restart_finds_the_files_of_the_order(host, damage):
    """Nothing forces them to the disk, so a loss of power leaves them in any of these states.

    The next supervisor has the content from the record, and needs neither slave nor master.
    """
    path = host.state / "logs" / "p.1.parameters.yaml"
    order = host.order(
        "p",
        "sh",
        "-c",
        f"cat {path}; exec sleep 1000",
        restart=ALWAYS,
        contents={str(path): CONTENT},
    )
    client = host.connect()
    client.start([order])
    host.running(client, "p")
    assert path.stat().st_mode & 0o777 == 0o600
    for runs in (1, 2, 3):
        wait_until(lambda runs=runs: host.log("p").read_text() == runs * CONTENT, "its output")
        client = host.replace_supervisor(client)
        damage(path)
        os.kill(client.instances[0].pid, signal.SIGKILL)
        host.running(client, "p")
    assert path.read_text() == CONTENT
    assert not path.is_symlink()


def test_a_file_that_is_right_needs_no_room(tmp_path):
    """A full disk delays the first start, for a reason that may pass, and no restart."""
    path, other = tmp_path / "disk" / "p.1.key", tmp_path / "disk" / "p.2.key"
    with small_disk(path.parent) as disk:
        provide(str(path), CONTENT)
        disk.fill()
        provide(str(path), CONTENT)
        with pytest.raises(SpawnError, match="No space left") as refused:
            provide(str(other), CONTENT)
        assert refused.value.transient
        assert [one.name for one in path.parent.glob("p.*")] == [path.name]
        disk.make_room()
        provide(str(other), CONTENT)
