"""Command line of the launcher `podman`; a program that answers yes stands for podman."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.extensions.contracts import Launch, LauncherContext
from rosrm.model.values import Assignment, Container, InstanceId, ProcessSpec
from rosrm_container import start
from rosrm_container.podman import Podman
from tests.limits import no_more_files

SPEC = ProcessSpec("p", command=("run", "-v"), container=Container("ros:jazzy", "podman"))
VARIABLES = {
    "AMENT_PREFIX_PATH": "/opt/ros", "HOME": "/root", "LD_LIBRARY_PATH": "/opt/ros/lib",
    "PLAIN": "x", "ROSRM_PROCESS": "p", "ROS_DISTRO": "jazzy", "ROS_DOMAIN_ID": "7",
}  # fmt: skip


@pytest.fixture
def launcher(tmp_path, monkeypatch) -> Podman:
    program = tmp_path / "bin" / "podman"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\n[ "$3" = ros:jazzy ]\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    return Podman(LauncherContext(tmp_path, sys.executable, 1))


def prepared(launcher: Podman, spec: ProcessSpec = SPEC, **variables: str) -> Launch:
    assignment = Assignment(InstanceId("p", 1), spec, 1, "p")
    launch = Launch(assignment, "rosrm", spec.command, {**VARIABLES, **variables})
    return launcher.prepare(launch)


def passed(launch: Launch) -> set[str]:
    """Return the values of the option `--env`."""
    return {word.removeprefix("--env=") for word in launch.argv if word.startswith("--env=")}


def test_the_container_gets_what_is_not_of_the_host(launcher) -> None:
    """Command lines have no values, and podman itself keeps the environment of the slave."""
    spec = replace(SPEC, environment={"PLAIN": "x"}, secrets={"TOKEN": "/t"})
    launch = prepared(launcher, spec)
    marks = {"ROSRM_INSTANCE", "ROSRM_SUPERVISOR"}
    assert passed(launch) == {"PLAIN", "TOKEN", "ROSRM_PROCESS", "ROS_DOMAIN_ID", *marks}
    assert launch.environment == VARIABLES
    assert launch.argv[-3:] == ("ros:jazzy", "run", "-v")


def test_a_variable_that_podman_reads_is_given_to_the_container_alone(launcher) -> None:
    """Otherwise podman would not find its own programs and its storage."""
    spec = replace(SPEC, environment={"PATH": "/app", "LD_PRELOAD": "/app/x.so"})
    launch = prepared(launcher, spec, PATH="/app", LD_PRELOAD="/app/x.so")
    assert {"PATH=/app", "LD_PRELOAD=/app/x.so"} <= passed(launch)
    assert launch.environment["PATH"] == os.environ["PATH"]
    assert "LD_PRELOAD" not in launch.environment
    with pytest.raises(ValueError, match="LD_PRELOAD cannot be a secret in a container"):
        prepared(launcher, replace(SPEC, secrets={"LD_PRELOAD": "/t"}))


def test_files_and_devices_of_the_process_are_in_the_container(launcher) -> None:
    """They have the same paths there."""
    command = ("talk", "--ros-args", "--params-file", "/s/p.yaml")
    spec = replace(SPEC, command=command, working_directory="/maps")
    launch = prepared(launcher, spec, ROSRM_DEVICE_CAMERA="/dev/video0,/dev/video2")
    mounted = {word for word in launch.argv if word.startswith(("--vol", "--dev", "--work"))}
    assert mounted == {
        "--volume=/maps:/maps", "--workdir=/maps", "--volume=/s/p.yaml:/s/p.yaml:ro",
        "--device=/dev/video0", "--device=/dev/video2",
    }  # fmt: skip


def test_a_host_without_the_image_refuses_the_process(launcher) -> None:
    """The reason names the command that gets the image."""
    spec = replace(SPEC, container=Container("ros:humble", "podman"))
    with pytest.raises(ValueError, match="podman has no image ros:humble on this host; `podman pu"):
        prepared(launcher, spec)


def test_other_processes_have_no_container(launcher) -> None:
    """Their leaders are not taken for podman."""
    assert launcher.leads(os.getpid()) is False
    assert launcher.members(os.getpid()) == (os.getpid(),)
    assert launcher.root(os.getpid()) == os.getpid()


def test_a_leader_without_a_command_line_may_run_a_container_soon(launcher) -> None:
    """The slave asks again later; otherwise it would not measure the container.

    A zombie stands for a process in its execve: neither has a command line in /proc.
    """
    with subprocess.Popen(["true"]) as process:
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert launcher.leads(process.pid) is None
    assert launcher.leads(process.pid) is False


def test_without_a_free_descriptor_the_members_of_a_container_are_unknown(launcher) -> None:
    """Otherwise the slave would forget its processes."""
    for ask in (launcher.leads, launcher.members, launcher.root):
        with no_more_files(), pytest.raises(OSError, match="Too many open files"):
            ask(os.getpid())


def test_the_key_of_the_instance_is_mounted_and_in_no_variable(launcher, tmp_path) -> None:
    """Any user of the container reads the copy, and no other user of the host finds it."""
    key = tmp_path / "p.key"
    key.write_bytes(b"c2VjcmV0")
    key.chmod(0o600)
    launch = prepared(launcher, ROSRM_INSTANCE_KEY_FILE=str(key))
    (volume,) = (word for word in launch.argv if word.startswith("--volume="))
    copy, inside, mode = volume.removeprefix("--volume=").split(":")
    assert f"ROSRM_INSTANCE_KEY_FILE={inside}" in passed(launch)
    assert mode == "ro"
    subprocess.run(launch.argv, env={**os.environ, **launch.environment}, check=False, timeout=60)
    assert Path(copy).read_bytes() == b"c2VjcmV0"
    assert stat.S_IMODE(Path(copy).stat().st_mode) == 0o444
    assert stat.S_IMODE(Path(copy).parent.stat().st_mode) == 0o700
    left_over = Path(copy).with_name("rosrm-other-p-1.key")
    left_over.touch()
    subprocess.run(launch.argv, env={**os.environ, **launch.environment}, check=False, timeout=60)
    assert not left_over.exists()


def test_a_container_whose_process_cannot_be_looked_at_is_not_removed(monkeypatch):
    """The system may have no room for another open file; the start is then tried again."""

    def full(_: Path) -> bytes:
        raise OSError(errno.ENFILE, os.strerror(errno.ENFILE))

    monkeypatch.setattr(Path, "read_bytes", full)
    with pytest.raises(OSError, match="Too many open files"):
        list(start._running())
