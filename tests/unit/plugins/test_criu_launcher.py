"""The start of an instance as the launcher of `criu` changes it."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from rosrm.errors import LaunchError, PortableError
from rosrm.extensions.contracts import Launch, LauncherContext
from rosrm.model.values import Assignment, InstanceId, MigrationPolicy, ProcessSpec
from rosrm_criu.engine.binary import PROGRAM_VARIABLE
from rosrm_criu.launcher import CriuLauncher
from tests.failing_calls import nth_call_fails
from tests.limits import no_more_files


def prepared(
    state: Path, *, slave: int = 1, cluster: str = "fleet", **fields: Any
) -> Launch | None:
    restored = fields.pop("restored", False)
    spec = ProcessSpec(**{"name": "p", "command": ("true",), "ros": True, **fields})
    assignment = Assignment(InstanceId("p", 7), spec, 1, "p", restored=restored)
    launch = Launch(assignment, cluster, spec.command, {"PATH": "/usr/bin:/bin"})
    return CriuLauncher(LauncherContext(state, sys.executable, slave)).prepare(launch)


def test_a_portable_node_is_told_where_it_is_asked_to_leave(tmp_path):
    """Each instance has a directory of its own, other than that of a cluster of the same name."""
    moves = {"migration": MigrationPolicy("criu")}
    made = prepared(tmp_path, **moves)
    for other in (
        prepared(tmp_path, cluster="other", **moves),
        prepared(tmp_path, slave=7, **moves),
    ):
        paths = [Path(one.environment["ROSRM_PORTABLE"]) for one in (made, other)]
        assert paths[0].parent == paths[1].parent
        assert paths[0] != paths[1]
    assert (
        "ROSRM_PORTABLE" not in prepared(tmp_path, migration=MigrationPolicy("handoff")).environment
    )


@pytest.mark.parametrize("program", ["no-such-program", "/no/such/program"])
def test_a_program_that_is_to_be_checkpointed_is_looked_for(tmp_path, program):
    """The wrapper that is started in its place would fail on each host, one after the other."""
    migration = MigrationPolicy("criu", options={"checkpoint_every": 10.0})
    with pytest.raises(LaunchError, match=f"'{program}' (is not on the PATH|exists)"):
        prepared(tmp_path, command=(program,), migration=migration)


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOMEM, errno.EIO])
def test_an_instance_does_not_lose_its_images_to_a_failed_look_at_criu(
    tmp_path, monkeypatch, number
):
    """Without CRIU no image is made until its end, so CRIU must be certainly absent."""
    program = tmp_path / "criu"
    program.write_text("#!/bin/sh\necho Version: 4.1\n")
    program.chmod(0o755)
    monkeypatch.delenv(PROGRAM_VARIABLE, raising=False)
    monkeypatch.setattr("rosrm_criu.engine.binary.default_prefix", lambda: tmp_path / "none")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    migration = MigrationPolicy("criu", options={"checkpoint_every": 10.0})
    prepared(tmp_path, migration=migration)  # loads the modules
    for n in range(1000):
        try:
            with nth_call_fails(n, number) as count:
                launch = prepared(tmp_path, migration=migration)
        except (LaunchError, OSError):
            continue
        assert any(word.startswith("--criu=") for word in launch.argv)  # maybe of another folder
        if not count.failed:
            break
    assert 5 < n < 1000


def test_a_restored_instance_without_an_image_here_is_left_to_other_launchers(tmp_path):
    """The image of a process that moves by another strategy may be of another launcher."""
    asked = {"restored": True, "migration": MigrationPolicy("relaunch")}
    assert prepared(tmp_path, **asked) is None


def test_a_launcher_without_a_free_descriptor_gives_no_answer(tmp_path):
    """An answer would end a node that is out of the graph, or forget the processes of a shim."""
    launcher, own = CriuLauncher(LauncherContext(tmp_path, sys.executable, 1)), os.getpid()
    for ask in (launcher.has_departed, launcher.leads, launcher.root, launcher.members):
        with no_more_files(), pytest.raises(OSError, match="Too many open files"):
            ask(own)
    assert (launcher.has_departed(own), launcher.leads(own)) == (False, False)


def test_a_status_that_cannot_be_read_for_want_of_descriptors_is_unknown(tmp_path, monkeypatch):
    """The file may say that the node has left the graph."""
    launcher = CriuLauncher(LauncherContext(tmp_path, sys.executable, 1))
    monkeypatch.setattr("rosrm_criu.launcher.directory_of", lambda _pid: tmp_path)
    assert launcher.has_departed(os.getpid()) is False

    def full(*_: object, **__: object) -> int:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with monkeypatch.context() as shortage:
        shortage.setattr(os, "open", full)
        with pytest.raises((OSError, PortableError), match="Too many open files"):
            launcher.has_departed(os.getpid())
