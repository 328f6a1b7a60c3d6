"""Conversion of an assignment into an order for the supervisor.

The order consists of command line, environment and parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rosrm.errors import LaunchError
from rosrm.extensions.contracts import Launch
from rosrm.model.values import Assignment, ProcessSpec, RestartPolicy
from rosrm.slave.launch import ament_index
from rosrm.slave.launch.environment import ProcessLocation, process_environment
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.launch.ros_arguments import join_arguments, parameters_text, ros_arguments
from rosrm.supervisor.client import log_path
from rosrm.supervisor.client_values import LaunchOrder


def launch_order(
    assignment: Assignment, base_environment: Mapping[str, str], python: str, *,
    where: ProcessLocation, state_directory: Path, launchers: Launchers, last_contact: float = 0.0,
) -> LaunchOrder:  # fmt: skip
    """Return the supervisor's order for an assignment, and write its parameters to a file.

    Args:
        base_environment: environment of the slave, with its ROS settings.
        python: the interpreter for modules.
        where: host and cluster of the instance.
        state_directory: of this host's supervisor; the parameters are beside the instance's log.
        last_contact: of the master with this host, monotonic seconds; 0.0: now.

    Raises:
        LaunchError: the program was not found, with the searched places; or another error of the
            spec on this host.
    """
    spec = assignment.spec
    environment = process_environment(assignment, base_environment, where, launchers.variables)
    command = _command(spec, environment, python)
    if spec.ros:
        parameters_file = _write_parameters(assignment, state_directory)
        ros = ros_arguments(spec, assignment.node_name, parameters_file)
        arguments = join_arguments(spec.arguments, ros)
    else:
        arguments = list(spec.arguments)
    plain = Launch(assignment, where.cluster, (*command, *arguments), environment)
    launch = launchers.prepare(plain)
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
        last_contact=last_contact,
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


def _write_parameters(assignment: Assignment, state_directory: Path) -> str | None:
    """Write the parameters beside the instance's log and return their path; pruned with the log.

    None: there are no parameters.
    """
    text = parameters_text(assignment.spec.parameters)
    if not text:
        return None
    path = log_path(state_directory, assignment.instance).with_suffix(".parameters.yaml")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.touch(0o600)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LaunchError(f"the parameters cannot be written: {error.strerror}") from None
    return str(path)
