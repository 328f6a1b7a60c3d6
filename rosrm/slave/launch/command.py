"""From an assignment to an order for the supervisor: command line, environment, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rosrm.errors import LaunchError
from rosrm.extensions.contracts import Launch
from rosrm.model.values import Assignment, ProcessSpec, RestartPolicy
from rosrm.slave.launch import ament_index
from rosrm.slave.launch.environment import Whereabouts, process_environment
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.launch.ros_arguments import join_arguments, parameters_text, ros_arguments
from rosrm.supervisor.client import LaunchOrder, log_path


def launch_order(
    assignment: Assignment,
    base_environment: Mapping[str, str],
    python: str,
    *,
    where: Whereabouts,
    state_directory: Path,
    launchers: Launchers,
    heard: float = 0.0,
) -> LaunchOrder:
    """What the supervisor is to start for an assignment; its parameters are written to a file.

    Args:
        assignment: what is to run.
        base_environment: the slave's own, its ROS settings included.
        python: the interpreter for modules.
        where: it will run.
        state_directory: of this host's supervisor; the parameters lie beside the instance's log.
        launchers: of this host.
        heard: when the master last heard this host, monotonic; 0.0: just now.

    Raises:
        LaunchError: what was looked for, and where.
    """
    spec = assignment.spec
    environment = process_environment(assignment, base_environment, where, launchers.variables)
    command = _command(spec, environment, python)
    if spec.ros_node:
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
        # One that ended in a move is never started again: the source is there, and may go on.
        restart=RestartPolicy("never") if assignment.on_trial else spec.restart,
        stop=spec.stop,
        fence=assignment.fence,
        heard=heard,
    )


def _working_directory(spec: ProcessSpec) -> str | None:
    """Return the directory that the process runs in; None: the supervisor's default."""
    if spec.working_directory is None:
        return None
    return _at_home(spec.working_directory, "working_directory")


def _at_home(path: str, where: str) -> str:
    """Replace a leading `~` by the home of the slave's user on this host."""
    if not path.startswith("~"):
        return path
    try:
        return str(Path(path).expanduser())
    except RuntimeError as error:
        raise LaunchError(f"{where} {path!r}: {error}") from None


def _command(spec: ProcessSpec, environment: Mapping[str, str], python: str) -> tuple[str, ...]:
    """What comes before the arguments."""
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
    """Beside the instance's log, to be pruned with it."""
    text = parameters_text(assignment.spec.parameters)
    if not text:
        return None
    path = log_path(state_directory, assignment.instance).with_suffix(".parameters.yaml")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.touch(0o600)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LaunchError(f"the parameters cannot be written to {path}: {error}") from None
    return str(path)
