"""Launcher of processes in containers: the session leader is the command `podman run`.

The container gets no control group of its own. So all its processes, and podman's monitor, are in
the group of the instance: rosrm limits, measures and kills them as those of any other process.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Final

import psutil

from rosrm import Launch, LauncherContext, SkipPlugin
from rosrm.shortage import raise_shortage
from rosrm_container import start

#: Seconds for a question to podman; the slave waits for the answer.
_PATIENCE: Final = 8.0
#: Beginnings of the names of variables that a process in a container gets from its slave.
_PASSED: Final = (
    "CUDA_", "CYCLONEDDS_", "FASTDDS_", "FASTRTPS_", "RMW_", "ROSRM_", "ROS_", "PYTHONUNBUFFERED",
)  # fmt: skip
#: Variables of these that describe the ROS installation of the host, or its files.
_OF_HOST: Final = (
    "ROS_DISTRO", "ROS_ETC_DIR", "ROS_HOME", "ROS_LOG_DIR", "ROS_PACKAGE_PATH",
    "ROS_PYTHON_VERSION", "ROS_ROOT", "ROS_VERSION", "ROSRM_EPOCH_FILE", start.KEY_FILE,
)  # fmt: skip
#: The key of the instance in the container. In a variable, `podman inspect` would show it.
_KEY: Final = "/run/rosrm-instance.key"
#: Variables that the supervisor adds; they mark the processes of an instance.
_MARKS: Final = ("ROSRM_INSTANCE", "ROSRM_SUPERVISOR")
#: Variables that podman itself reads.
_OF_PODMAN: Final = ("HOME", "PATH", "TMPDIR")
_OF_PODMAN_TOO: Final = ("CONTAINER", "LD_", "XDG_")


class Podman:
    """Implementation of the launcher contract and of `ProcessTreeLauncher`."""

    def __init__(self, context: LauncherContext) -> None:
        program = shutil.which("podman")
        if program is None:
            raise SkipPlugin("podman is not installed")
        self._program, self._python = program, context.python
        self._label = sha256(os.fsencode(context.state)).hexdigest()[:12]
        self._folder = context.state / "containers"
        self._images: set[str] = set()  # those that were on this host once

    def prepare(self, launch: Launch) -> Launch | None:
        """Return the start of a container that runs the command of the process."""
        spec, instance = launch.assignment.spec, launch.assignment.instance
        image = spec.container.image
        if launch.assignment.restored:
            return None
        if not image:
            raise ValueError(f"{instance}: `container` names no image for podman")
        if not self._has_image(image):
            raise ValueError(
                f"{instance}: podman has no image {image} on this host; `podman pull {image}` gets "
                "it, as the user of the slave"
            )
        self._folder.mkdir(mode=0o700, exist_ok=True)
        name = f"rosrm-{self._label}-{instance.process}-{instance.number}"
        environment, variables = _variables(launch)
        run = [
            self._program, "run", "--rm", "--replace", f"--name={name}",
            f"--label={start.LABEL}={self._label}", f"--pidfile={self._folder / name}.pid",
            "--pull=never", "--network=host", "--ipc=host", "--init", "--cgroups=disabled",
            "--log-driver=none", "--sdnotify=ignore", *variables, *_mounts(launch),
            *_key_options(launch, self._folder / name), image,
            *launch.argv,
        ]  # fmt: skip
        argv = (self._python, "-I", "-S", start.__file__, *run)
        return replace(launch, argv=argv, environment=environment)

    def leads(self, leader: int) -> bool | None:
        """Return True if the leader starts or runs a container of this slave; None: unknown yet.

        During an execve, as right after its spawn, a process has no command line in /proc.
        """
        return None if _words(leader) == [b""] else self._pid_file(leader) is not None

    def members(self, leader: int) -> Sequence[int]:
        """Return podman, its monitor, and all processes of the container."""
        first = self._first(leader)
        if first is None:
            return (leader,)
        try:
            monitor = [one for one in first.parents()[:1] if one.name() == "conmon"]
            found = [*monitor, first, *first.children(recursive=True)]
        except psutil.Error:  # the container has ended
            return (leader,)
        return (leader, *(one.pid for one in found))

    def root(self, leader: int) -> int:
        """Return the process itself, the child of the container's init; before it runs, podman."""
        first = self._first(leader)
        try:
            children = [] if first is None else first.children()
        except psutil.Error:  # the container has ended
            return leader
        return children[0].pid if children else leader

    def _first(self, leader: int) -> psutil.Process | None:
        """Return the init process of the container that a leader runs; None: it does not run."""
        file = self._pid_file(leader)
        if file is None:
            return None
        try:
            return psutil.Process(int(file.read_text()))
        except (OSError, ValueError, psutil.Error) as error:
            if isinstance(error, OSError):
                raise_shortage(error)
            return None

    def _pid_file(self, leader: int) -> Path | None:
        """Return the file with the pid of the container that a process runs; None: it runs none."""
        prefix = os.fsencode(f"--pidfile={self._folder}/")
        found = (word for word in _words(leader) if word.startswith(prefix))
        option = next(found, None)
        return None if option is None else Path(os.fsdecode(option.partition(b"=")[2]))

    def _has_image(self, image: str) -> bool:
        """Return True if an image is on this host; a question takes 0.1 s, so ask once for each."""
        if image in self._images:
            return True
        command = [self._program, "image", "exists", image]
        try:
            answer = subprocess.run(
                command, capture_output=True, timeout=_PATIENCE, check=False,
                stdin=subprocess.DEVNULL, text=True,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise ValueError(f"podman did not answer within {_PATIENCE:g} s") from None
        if answer.returncode > 1:
            raise ValueError(f"podman fails on this host: {answer.stderr.strip()}")
        if answer.returncode == 0:
            self._images.add(image)
        return answer.returncode == 0


def _words(pid: int) -> list[bytes]:
    """Return the command line; [b""] during an execve, [] if there is no such process.

    Raises:
        OSError: the system has no room for a look.
    """
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError as error:
        raise_shortage(error)
        return []


def _variables(launch: Launch) -> tuple[dict[str, str], list[str]]:
    """Return the environment of podman, and its options that pass variables on to the container.

    The options name the variables only, because every user of a host can read command lines.
    Variables that would change podman itself are given with their values.
    """
    spec, environment = launch.assignment.spec, dict(launch.environment)
    names = {name for name in environment if name.startswith(_PASSED) and name not in _OF_HOST}
    options = []
    for name in sorted({*names, *spec.environment, *spec.secrets, *_MARKS}):
        if name in _OF_PODMAN or name.startswith(_OF_PODMAN_TOO):
            if name in spec.secrets:
                raise ValueError(f"{name} cannot be a secret in a container: podman reads it, too")
            if name in spec.environment:
                options.append(f"--env={name}={environment.pop(name)}")
                environment.update({name: os.environ[name]} if name in os.environ else {})
        else:
            options.append(f"--env={name}")
    return environment, options


def _key_options(launch: Launch, own: Path) -> Iterator[str]:
    """Yield options that give the container the key of its instance in a file.

    Args:
        own: path of the files of the container; the copy is made at each start (`start`).
    """
    if start.KEY_FILE in launch.environment:
        yield f"--volume={own}.key:{_KEY}:ro"
        yield f"--env={start.KEY_FILE}={_KEY}"


def _mounts(launch: Launch) -> Iterator[str]:
    """Yield options that make files of the host visible in the container, at the same paths."""
    directory = launch.assignment.spec.working_directory
    if directory is not None:
        directory = str(Path(directory).expanduser())
        yield f"--volume={directory}:{directory}"
        yield f"--workdir={directory}"
    for option, path in zip(launch.argv, launch.argv[1:], strict=False):
        if option == "--params-file" and path.startswith("/"):
            yield f"--volume={path}:{path}:ro"
    for name, value in launch.environment.items():
        if name.startswith("ROSRM_DEVICE_"):
            yield from (f"--device={one}" for one in value.split(",") if one.startswith("/dev/"))
