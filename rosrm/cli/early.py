"""DDS participant that is created before the command line is parsed.

A command that can use the socket of a master on this machine creates none. The discovery of the
master takes 0.1 to 0.3 s in threads of DDS. The imports for parsing and tables take as long. Both
run in parallel if the participant is created first.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rosrm.model.ros_settings import RosSettings
from rosrm.ros import names

if TYPE_CHECKING:
    from rosrm.ros.participant import Participant

#: Commands that send requests to the master.
ASKING: Final = frozenset({
    "submit", "adopt", "apply", "revert", "mode", "run", "cancel", "restart", "migrate",
    "checkpoint", "restore", "prune", "cordon", "uncordon", "drain", "rebalance", "reload",
    "status", "ps", "apps", "history", "hosts", "plugins", "explain",
    "events", "logs", "top",
})  # fmt: skip
#: Commands that also read the logs of slaves, or the load of the master, over DDS.
_BEYOND_MASTER: Final = frozenset({"logs", "run", "top"})
#: The sockets of this machine (of the network namespace), with a line for each.
_SOCKETS: Final = Path("/proc/net/unix")
#: Options with which a command joins ROS with other settings or not at all.
_OTHERWISE: Final = ("-h", "--help", "--domain", "--cluster", "--local")

_made: list[Participant] = []


def join(arguments: Sequence[str], environment: Mapping[str, str]) -> None:
    """Join ROS with the settings of the environment, if the command surely needs the master.

    Args:
        arguments: arguments of the command line.
        environment: environment variables; if they name a file with ROS settings, do nothing,
            because `connect` joins ROS with that file.
    """
    if not _is_wanted(arguments, environment):
        return
    try:
        socket, _ = RosSettings().socket_name()
        if arguments[0] not in _BEYOND_MASTER and f" @{socket}" in _SOCKETS.read_text(
            errors="replace"
        ):
            return
        from rosrm.ros.participant import Participant  # noqa: PLC0415 - the first import of ROS

        _made.append(Participant(RosSettings(), names.client_node()))
    except Exception:  # noqa: BLE001 - `connect` retries, and reports the error to the user
        _made.clear()


def completed_words(environment: Mapping[str, str]) -> list[str]:
    """Return the words of the command line that a shell completes; []: this is no completion."""
    if "_ROSRM_COMPLETE" not in environment:
        return []
    line = environment.get("_TYPER_COMPLETE_ARGS") or environment.get("COMP_WORDS", "")
    return line.split()[1:]


def _is_wanted(arguments: Collection[str], environment: Mapping[str, str]) -> bool:
    first = next(iter(arguments), "")
    otherwise = any(argument.startswith(_OTHERWISE) for argument in arguments)
    return first in ASKING and not otherwise and not environment.get("ROSRM_CLUSTER")


def take(settings: RosSettings) -> Participant | None:
    """Return the participant if it has the same settings; the caller closes it."""
    return _made.pop() if _made and _made[0].settings == settings else None


def drop() -> None:
    """Close a participant that no command has taken, e.g. after a wrong command line."""
    while _made:
        _made.pop().close()
