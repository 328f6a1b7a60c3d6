"""A virtual host as processes: the first one, the entrance for others, and the end of all."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import ConfigError, LabError
from rosrm.runtime.ros_wheels import without_bootstrapper
from rosrm.runtime.signalling import send_by
from rosrm_lab import groups, store
from rosrm_lab import plan as names
from rosrm_lab.groups import Hierarchy, Leaf
from rosrm_lab.needs import find_command
from rosrm_lab.plan import HostPlan
from rosrm_lab.store import Birth

#: Mount point of a host's disk, as seen by its processes.
DATA: Final = Path("/run/data")

_INSIDE: Final = Path(__file__).parent / "inside"
#: Seconds for the namespaces and mounts of a host.
_BOOT: Final = 30.0
#: Seconds for a kernel to end the processes of a host.
_END: Final = 10.0
#: Shell script that enters control groups, then executes the rest: N FILE... COMMAND...
_ENTER: Final = (
    'n=$1; shift; while [ "$n" -gt 0 ]; do { echo 0 > "$1"; } 2>/dev/null || '
    '{ echo "rosrm: the host has gone" >&2; exit 125; }; shift; n=$((n - 1)); done; exec "$@"'
)
#: Variables that would point discovery outside the lab, or disable it.
_NOT_INHERITED: Final = (
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_ENVIRONMENT_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "CYCLONEDDS_URI",
    "XDG_RUNTIME_DIR",
)


@dataclass(frozen=True, slots=True)
class Entrance:
    """A command line that executes a command on a host.

    Attributes:
        command: the whole command line.
        environment: all variables.
        descriptors: that it must inherit; the caller of `entrance` closes them.
    """

    command: list[str]
    environment: dict[str, str]
    descriptors: list[int]


def boot(hierarchies: Sequence[Hierarchy], lab: str, host: HostPlan, hosts_file: str) -> Birth:
    """Start the first process of a host, whose network and groups exist already.

    Raises:
        LabError: a namespace or mount could not be made.
    """
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb", buffering=0) as ready:
        try:
            # A session of its own, because a Ctrl-C during the boot is for this process, which
            # then removes everything.
            launcher = subprocess.Popen(
                _booting(hierarchies, lab, host, hosts_file, writer),
                pass_fds=[writer],
                env=without_bootstrapper(os.environ),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        finally:
            os.close(writer)
        lines = _until_ready(ready.fileno(), clocks.boot_time() + _BOOT)
        output = _last_words(launcher)
    pid = next((int(line[4:]) for line in lines if line.startswith("pid ")), 0)
    birth = Birth.of(pid) if pid and lines[-1] == "ready" else None
    if birth is None:
        reasons = [line[7:] for line in lines if line.startswith("failed ")]
        reason = "; ".join([*reasons, output]).strip("; ") or f"not ready in {_BOOT:g} s"
        raise LabError(f"host {host.name} of lab {lab!r} could not be booted: {reason}")
    return birth


def entrance(
    hierarchies: Sequence[Hierarchy],
    record: store.LabRecord,
    host: str,
    command: Sequence[str],
    *,
    leaf: Leaf = "limited",
    user: str = "",
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
) -> Entrance:
    """Return the command line that executes a command on a host.

    Args:
        leaf: of the host's groups.
        user: name of the user to run as; "": the user of this process.
        environment: variables on top of this process's and those of the host.
        directory: to start in; None: this process's. If the host lacks it, the host's disk.

    Raises:
        LabError: the host is off.
        ConfigError: no command, or an unknown user.
    """
    lab = record.plan.name
    record.plan.host(host)
    if not command:
        raise ConfigError("no command was given to execute")
    birth = record.inits.get(host)
    if birth is None or not birth.alive:
        raise LabError(f"host {host} of lab {lab!r} is off; `rosrm lab boot {host}` switches it on")
    identity, of_user = _identity(user)
    descriptors: list[int] = []
    try:
        for door in groups.doors(hierarchies, lab, host, leaf):
            descriptors.append(os.open(door, os.O_WRONLY))  # noqa: PERF401 - closed if one fails
    except OSError as error:
        _close(descriptors)
        raise LabError(f"host {host} of lab {lab!r} has lost its control group: {error}") from None
    order = {
        "lab": lab,
        "host": host,
        "doors": descriptors,
        "directory": directory or _working_directory(),
        "data": str(DATA),
        "identity": identity,
    }
    words = [
        *_entering(hierarchies, lab, host),
        *(find_command("nsenter"), "--target", str(birth.pid), "--no-fork"),
        *("--mount", "--uts", "--ipc", "--net", "--pid", "--"),
        *(sys.executable, "-I", "-S", str(_INSIDE / "relay.py"), json.dumps(order), *command),
    ]
    variables = {**host_environment(os.environ, host), **of_user, **(environment or {})}
    return Entrance(words, variables, descriptors)


def host_environment(base: Mapping[str, str], host: str) -> dict[str, str]:
    """Return the variables of a process on a host.

    Args:
        base: the caller's variables; those about ROS discovery are dropped, as invalid in a lab.
        host: its name.
    """
    environment = without_bootstrapper(base)
    for name in _NOT_INHERITED:
        environment.pop(name, None)
    environment.update(
        ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET",
        ROSRM_SCOPE="cgroup",
        HOSTNAME=host,
        XDG_STATE_HOME=str(DATA / "state"),
        TMPDIR=str(DATA / "tmp"),
        ROS_HOME=str(DATA / "ros"),
    )
    environment.pop("ROS_LOG_DIR", None)  # the default is below ROS_HOME
    return environment


def power_off(hierarchies: Sequence[Hierarchy], lab: str, host: str, birth: Birth | None) -> None:
    """End all processes of a host at once; raises `LabError` where they do not end.

    Args:
        birth: identity of its first process; None: not known.
    """
    if birth is not None and birth.alive:
        with contextlib.suppress(ProcessLookupError), _pid_descriptor(birth.pid) as descriptor:
            if birth.alive:  # now the descriptor cannot be a later process's
                send_by(descriptor, signal.SIGKILL)
                # PID 1 of a namespace ends last: all other processes have ended before.
                if not _readable(descriptor, _END):
                    raise LabError(f"host {host} of lab {lab!r} did not end within {_END:g} s")
    groups.kill(hierarchies, lab, host)


def _booting(
    hierarchies: Sequence[Hierarchy], lab: str, host: HostPlan, hosts_file: str, ready: int
) -> list[str]:
    """Return the command line that starts a host's first process, which reports to `ready`."""
    settings = {
        "ready": ready,
        "hostname": host.name,
        "image": str(store.image(lab, host.name)),
        "shm_options": f"size={host.memory // 2}" if host.memory else "",
        "hosts_file": hosts_file,
    }
    namespace = names.namespace_path(names.host_namespace(lab, host.name))
    return [
        *_entering(hierarchies, lab, host.name),
        *(find_command("nsenter"), f"--net={namespace}", "--"),
        *(find_command("unshare"), "--mount", "--uts", "--ipc", "--pid"),
        *("--propagation", "private", "--"),
        *(sys.executable, "-I", "-S", str(_INSIDE / "init.py"), json.dumps(settings)),
    ]


def _entering(hierarchies: Sequence[Hierarchy], lab: str, host: str) -> list[str]:
    """Return a command prefix that puts the command into the lab's own control group first.

    So the removal of the lab finds the process in any case, and it cannot begin after the removal.
    """
    doors = [str(door) for door in groups.doors(hierarchies, lab, host, "own")]
    return ["/bin/sh", "-c", _ENTER, "rosrm-lab", str(len(doors)), *doors]


@contextlib.contextmanager
def _pid_descriptor(pid: int) -> Iterator[int]:
    descriptor = os.pidfd_open(pid)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _readable(descriptor: int, timeout: float) -> bool:
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(timeout * 1000.0))


def _until_ready(reader: int, deadline: float) -> list[str]:
    """Return the lines of the first process, until it is ready, has failed or takes too long."""
    said = b""
    while not (said.endswith(b"\n") and said.split(b"\n")[-2].startswith((b"ready", b"failed"))):
        if not _readable(reader, max(0.0, deadline - clocks.boot_time())):
            break
        part = os.read(reader, 4096)
        if not part:
            break
        said += part
    return said.decode(errors="replace").splitlines() or [""]


def _last_words(launcher: subprocess.Popen[bytes]) -> str:
    """Return the launcher's output; its first child closes the output when it is ready."""
    try:
        output, _ = launcher.communicate(timeout=5.0)
    except subprocess.TimeoutExpired:
        launcher.kill()
        launcher.wait()
        return "its output stays open"
    return output.decode(errors="replace").strip()


def _identity(user: str) -> tuple[list[str], dict[str, str]]:
    """Return options of setpriv, and variables, that run a process as a user."""
    if not user:
        return [], {}
    import pwd  # noqa: PLC0415 - seldom needed

    try:
        entry = pwd.getpwnam(user)
    except KeyError:
        raise ConfigError(f"there is no user {user!r} on this machine") from None
    options = [f"--reuid={entry.pw_uid}", f"--regid={entry.pw_gid}", "--init-groups"]
    return options, {"HOME": entry.pw_dir, "USER": user, "LOGNAME": user}


def _working_directory() -> str:
    try:
        return str(Path.cwd())
    except FileNotFoundError:  # the directory was removed
        return "/"


def _close(descriptors: Sequence[int]) -> None:
    for descriptor in descriptors:
        os.close(descriptor)
