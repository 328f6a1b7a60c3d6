"""Conversion of an assignment into an order for the supervisor.

The order consists of command line, environment, and the files that the instance reads.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from rosrm.core.supervisor.rules import AdoptionRule
from rosrm.errors import LaunchError
from rosrm.extensions.contracts import Launch
from rosrm.model.adoption import NO_ADOPTION, Adoption
from rosrm.model.relative_files import relative_files
from rosrm.model.values import Assignment, InstanceId, ProcessSpec, RestartPolicy
from rosrm.runtime import durable
from rosrm.runtime.path_calls import at
from rosrm.slave.launch import ament_index
from rosrm.slave.launch.artifacts import with_artifacts
from rosrm.slave.launch.devices import with_devices
from rosrm.slave.launch.environment import ProcessLocation, process_environment
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.launch.packages import with_packages
from rosrm.slave.launch.parameter_files import all_parameters
from rosrm.slave.launch.ros_arguments import join_arguments, parameters_text, ros_arguments
from rosrm.supervisor import json_lines
from rosrm.supervisor.client import log_path
from rosrm.supervisor.client_values import LaunchOrder, limit_rule
from rosrm.wording import reason_of

#: Most bytes of command line and environment, as the supervisor receives them; the rest of its
#: longest line is for the other fields.
_LONGEST: Final = json_lines.LONGEST_LINE - (1 << 16)
#: Shell script that becomes an executable of a ROS package; `ros2 run` would stay its parent, and
#: would not pass on a signal that only the container's first process gets.
_RUN_PACKAGE: Final = (
    'p=$1 e=$2; shift 2; d=$(ros2 pkg prefix "$p") || exit 127; exec "$d/lib/$p/$e" "$@"'
)
#: Characters that are always short enough: JSON has at most 12 bytes for each.
_SHORT: Final = _LONGEST // 16


class PlainLaunch(NamedTuple):
    """A launch before a launcher changes it.

    Attributes:
        contents: as in `LaunchOrder`.
    """

    launch: Launch
    contents: Mapping[str, str]


def plain_launch(
    assignment: Assignment, base_environment: Mapping[str, str], python: str, *,
    where: ProcessLocation, state_directory: Path, launchers: Launchers,
) -> PlainLaunch:  # fmt: skip
    """Return the launch of an assignment without a launcher, with its parameters and its key.

    Args:
        base_environment: environment of the slave, with its ROS settings.
        python: the interpreter for modules.
        where: host and cluster of the instance.
        state_directory: of this host's supervisor. The files are beside the instance's log, and
            are removed with it.

    Raises:
        LaunchError: the program was not found, with the searched places; or another error of the
            spec on this host.
    """
    assignment = with_artifacts(with_devices(assignment, where.devices), where.artifacts)
    spec, files = assignment.spec, {}
    key, key_file = where.instance_key(assignment.instance), ""
    if key is not None:
        key_file = str(key_path(state_directory, assignment.instance))
        files[key_file] = base64.b64encode(key).decode()
    made = (base_environment, where, launchers.variables, key_file)
    environment = process_environment(assignment, *made)
    filled = with_packages(spec, ament_index.search_path(environment, python))
    if filled is not spec:
        spec, assignment = filled, replace(assignment, spec=filled)
        environment = process_environment(assignment, *made)
    try:
        command = (*spec.prefix, *_command(spec, environment, python))
        arguments = _arguments(assignment, state_directory, files)
    except (OSError, ValueError) as error:  # a folder of another user, a text without encoding
        raise LaunchError(f"{assignment.instance}: {error}") from None
    launch = Launch(assignment, where.cluster, (*command, *arguments), environment)
    return PlainLaunch(launch, files)


def order_of(plain: PlainLaunch, launchers: Launchers, host: str) -> LaunchOrder:
    """Return the supervisor's order for a launch, as the launcher of its process changes it.

    Raises:
        LaunchError: the launcher fails, or this host cannot start the process.
    """
    launch, assignment = launchers.prepare(plain.launch), plain.launch.assignment
    spec = assignment.spec
    _check_length(launch, plain.contents)
    return LaunchOrder(
        instance=assignment.instance,
        argv=launch.argv,
        environment=launch.environment,
        working_directory=_working_directory(spec),
        # A destination that ends during a migration is not restarted, because the source still
        # exists and may continue.
        restart=RestartPolicy("never") if assignment.on_trial else spec.restart,
        stop=spec.stop,
        fence=assignment.fence,
        limits=limit_rule(spec),
        secrets=spec.secrets,
        adoption=_adoption(spec.adoption, host),
        files=relative_files(spec),
        contents=plain.contents,
    )


def _adoption(adoption: Adoption, host: str) -> AdoptionRule | None:
    """Return the process that becomes the first run; None: the first run is started."""
    if adoption == NO_ADOPTION:
        return None
    if adoption.host != host:
        raise LaunchError(
            f"process {adoption.pid} runs on {adoption.host}, so {host} cannot run it"
        )
    return AdoptionRule(adoption.pid, adoption.birth, adoption.boot)


def _check_length(launch: Launch, files: Mapping[str, str]) -> None:
    """Raise `LaunchError` if the supervisor would refuse the order, which is one line for it."""
    texts = (*launch.environment, *launch.environment.values(), *files.values())
    parts = (*launch.argv, *texts)
    if sum(map(len, parts)) + len(parts) < _SHORT:
        return
    length = len(json_lines.line({"parts": parts}))
    if length > _LONGEST:
        raise LaunchError(
            f"{launch.assignment.instance}: command line, environment and parameters have {length} "
            f"bytes; allowed: {_LONGEST}. Pass long texts in a file"
        )


def _working_directory(spec: ProcessSpec) -> str | None:
    """Return the directory that the process runs in; None: the supervisor's default."""
    if spec.working_directory is None:
        return None
    return _at_home(spec.working_directory, "working_directory")


def _at_home(path: str, where: str) -> str:
    """Return a path with a leading `~` replaced by the home of the slave's user."""
    if not path.startswith("~"):
        return path
    try:
        return str(Path(path).expanduser())
    except RuntimeError as error:
        raise LaunchError(f"{where} {path!r}: {error}") from None


def _command(spec: ProcessSpec, environment: Mapping[str, str], python: str) -> tuple[str, ...]:
    """Return the part of the command line before the arguments."""
    if spec.container.image:
        return command_in_image(spec)
    if spec.package is not None:
        if spec.executable is None:
            raise LaunchError(f"{spec.name!r} names the package {spec.package!r}, no executable")
        prefixes = ament_index.search_path(environment, python)
        return (str(ament_index.find_executable(spec.package, spec.executable, prefixes)),)
    if spec.module is not None:
        return (python, "-m", spec.module)
    if not spec.command:
        raise LaunchError(f"{spec.name!r} has nothing to run: set package, module or command")
    program, *words = spec.command
    return (_at_home(program, "command"), *words)


def command_in_image(spec: ProcessSpec) -> tuple[str, ...]:
    """Return a command that finds the program in the image of a container."""
    if spec.package is not None:
        return ("sh", "-c", _RUN_PACKAGE, "sh", spec.package, spec.executable or "")
    if spec.module is not None:
        return ("python3", "-m", spec.module)
    return spec.command


def write_files(files: Mapping[str, str]) -> None:
    """Write the files of an instance, durably, for a supervisor of an earlier version.

    Such a supervisor does not write them before a start, so they must survive a loss of power.

    Raises:
        LaunchError: a file cannot be written.
    """
    for path, content in files.items():
        at(path)
        try:
            Path(path).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            durable.replace_durably(path, content.encode())
        except OSError as error:
            raise LaunchError(f"{path} cannot be written: {reason_of(error)}") from None


def key_path(state_directory: Path, instance: InstanceId) -> Path:
    """Return the file with the key of an instance."""
    return log_path(state_directory, instance).with_suffix(".key")


def _arguments(assignment: Assignment, state_directory: Path, files: dict[str, str]) -> list[str]:
    """Return the arguments of a command line; add the parameters of a node to the files."""
    spec = assignment.spec
    if not spec.ros:
        return list(spec.arguments)
    parameters_file = None
    text = parameters_text(all_parameters(spec, assignment.node_name))
    if text:
        text.encode()  # a ValueError here refuses only this instance, with its name
        log = log_path(state_directory, assignment.instance)
        parameters_file = str(log.with_suffix(".parameters.yaml"))
        files[parameters_file] = text
    ros = ros_arguments(spec, assignment.node_name, parameters_file)
    return join_arguments(spec.arguments, ros)
