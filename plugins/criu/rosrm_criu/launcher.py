"""CRIU's launcher: starts portable nodes, and restores processes from images.

A portable node gets the path of its control directory. A process with a present or future image is
started by a program that restores it and stays its parent.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from rosrm import InstanceId, Launch, LauncherContext, ProcessSpec, options_of
from rosrm.errors import CriuError, LaunchError, PortableError
from rosrm.ros.names import token
from rosrm.shortage import exists, raise_shortage
from rosrm.supervisor.spawn import find_executable
from rosrm.supervisor.spawn_error import SpawnError
from rosrm_criu.control.client import directory_of, make_control_root
from rosrm_criu.control.messages import VARIABLE, State, Status, read_message
from rosrm_criu.engine import paths, process_tree, restart_from_image, restore_result, slots
from rosrm_criu.engine.binary import CriuUnknownError, find
from rosrm_criu.options import NAME, CriuOptions, OwnCriuOptions

#: Most seconds for a restore; the master gives up sooner.
_RESTORE: Final = 600.0


class CriuLauncher:
    """Implementation of the launcher contract and of all its optional parts."""

    def __init__(self, context: LauncherContext) -> None:
        self._state, self._python, self._slave = context.state, context.python, context.slave

    def prepare(self, launch: Launch) -> Launch | None:
        """Name the control directory of a portable node, and restore what has an image."""
        spec, instance = launch.assignment.spec, launch.assignment.instance
        restored, portable = launch.assignment.restored, _is_portable(spec)
        incoming = paths.incoming(self._state, instance.number)
        if restored and not portable and not exists(incoming):
            return None
        environment, argv = dict(launch.environment), launch.argv
        if portable and VARIABLE not in spec.environment:
            # The token differs for another cluster of the same name that shares this directory.
            own = token(f"{instance} {launch.cluster} {self._slave:x}")
            environment[VARIABLE] = str(_control_root() / own)
        again_from_image = _is_periodic(spec)
        if again_from_image:  # otherwise the restoring program would start, and fail only later
            _check_program(argv[0], environment)
        if again_from_image or restored:
            criu = self._criu(instance, restored)
            if criu is None:
                return replace(launch, environment=environment)
            if again_from_image:
                images = paths.periodic(self._state, instance.number)
                argv = restart_from_image.command(
                    self._python, images, argv, criu=criu, timeout=_RESTORE
                )
            if restored:
                argv = restore_result.command(
                    self._python, incoming, criu=criu, remove=True, timeout=_RESTORE, then=argv
                )
        return replace(launch, argv=argv, environment=environment)

    @staticmethod
    def _criu(instance: InstanceId, restored: bool) -> Path | None:
        """Return the program; None: there is none, and the instance starts without it.

        An instance without it has no images until its end, so a failed look starts none.
        """
        try:
            return Path(find().command[-1])
        except CriuUnknownError as error:
            raise LaunchError(f"{instance} is not started without knowing CRIU: {error}") from None
        except CriuError as error:
            if not restored:
                return None
            raise LaunchError(f"{instance} cannot be restored: {error}") from None

    def discard_images(self, instance: InstanceId) -> None:
        """Make the next start ignore all periodic images."""
        slots.start_without_image(paths.periodic(self._state, instance.number))

    def leads(self, leader: int) -> bool | None:
        """Return True if the leader is a shim; None: not yet, but it may become one."""
        return process_tree.leads(leader)

    def members(self, leader: int) -> Sequence[int]:
        """Return the shim and all its descendants."""
        return process_tree.tree(leader)

    def root(self, leader: int) -> int:
        """Return the restored process; while the restore runs, CRIU."""
        return process_tree.root_of(leader)

    def has_departed(self, leader: int) -> bool:
        """Return True while the node is out of the graph for a move or a checkpoint."""
        try:
            control = directory_of(process_tree.root_of(leader))
            status = None if control is None else read_message(control, Status)
        except (OSError, PortableError) as error:
            # It has ended, or wrote no status: treat it like any other, unless no file can be read.
            for one in (error, error.__cause__):
                if isinstance(one, OSError):
                    raise_shortage(one)
            return False
        return status is not None and status.state in (State.LEAVING, State.LEFT, State.JOINING)


def _control_root() -> Path:
    """Create the parent of control directories of this user; raise `LaunchError` if none can be."""
    try:
        return make_control_root(os.geteuid())
    except PortableError as error:
        raise LaunchError(str(error)) from None


def _is_portable(spec: ProcessSpec) -> bool:
    """Return True if its node is asked to leave the ROS graph before its memory is dumped."""
    return bool(spec.ros) and spec.migration.strategy == NAME


def _is_periodic(spec: ProcessSpec) -> bool:
    """Return True if a process asks for periodic checkpoints."""
    if not _is_portable(spec):
        return False
    return options_of(spec, CriuOptions(), OwnCriuOptions).checkpoint_every > 0.0


def _check_program(word: str, environment: dict[str, str]) -> None:
    """Raise `LaunchError` if a command's program is missing on this host."""
    try:
        path = find_executable(word, environment)
    except SpawnError as error:
        if error.transient:  # the program may be there, and its exec reports what it lacks
            return
        raise LaunchError(str(error)) from None
    if path.startswith("/") and not os.access(path, os.X_OK):
        raise LaunchError(f"no executable {path!r} exists")
