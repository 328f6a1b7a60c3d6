"""Every error that rosrm raises on purpose."""

from __future__ import annotations

from traceback import walk_tb
from typing import Final

#: Packages through which a plugin is loaded and called: their frames are never the plugin's own.
_LOADERS: Final = frozenset({"rosrm", "pkgutil", "importlib", "pluggy"})


class RosrmError(Exception):
    """An error for the user: its text is the whole message, and no traceback is shown."""

    exit_code = 1


class ConfigError(RosrmError):
    """A file or an option that cannot be accepted; nothing of it was used."""

    exit_code = 2


class PluginError(RosrmError):
    """A plugin that does not import, raises, hangs or answers nonsense."""


class Refused(RosrmError):
    """A request that was understood and turned down; nothing was changed.

    Args:
        message: what, where, what is allowed.
        code: the reason in one word, as in `rosrm_msgs/Answer`.
    """

    def __init__(self, message: str, code: str = "invalid") -> None:
        super().__init__(message)
        self.code = code


class NoMaster(RosrmError):
    """No master answered in time."""

    exit_code = 3


class LaunchError(RosrmError):
    """A process that cannot be started on this host, and why.

    Only the first line is the reason: details such as a whole PATH go into further lines.
    """


class JournalError(RosrmError):
    """The durable record cannot be read or written."""


class JournalBlocked(JournalError):
    """The durable record cannot be written just now; nothing was changed, it may be tried again.

    Args:
        message: for who started the master.
        public: for clients, without paths of the master's machine; "": the message.
    """

    def __init__(self, message: str, public: str = "") -> None:
        super().__init__(message)
        self.public = public or message


class RecordError(RosrmError):
    """The record of a master's run is none, damaged, cut short, or of another version."""

    exit_code = 2


class SupervisorError(RosrmError):
    """The supervisor of this host cannot be started or reached."""


class TransferError(RosrmError):
    """A directory cannot be offered to another host, or fetched from one; nothing is left of it."""


class LabError(RosrmError):
    """A virtual host or its network cannot be made, changed or found."""


class CriuError(RosrmError):
    """There is no CRIU that works here, or it could not dump or restore, and why."""


class PortableError(RosrmError):
    """A node that cannot be asked to leave the ROS graph or to join it again, or does not do it."""


class SkipPlugin(Exception):
    """Raised by a plugin's `create` to say that it is absent on this host, and why."""


# --- errors of other people's code ------------------------------------------------------------


def describe_fault(fault: BaseException) -> str:
    """Return an exception in one line: its type and its text."""
    try:
        text = " ".join(str(fault).split())
    except Exception:  # noqa: BLE001 - a plugin's own exception may fail to give its text
        text = ""
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def describe_plugin_fault(fault: BaseException) -> str:
    """Return an exception in one line with the place in the plugin that raised it.

    A `PluginError` is rosrm's own sentence about an answer, and is returned as it is.
    """
    if isinstance(fault, PluginError):
        return str(fault)
    place = _place_in_plugin(fault)
    return describe_fault(fault) + (f" ({place})" if place else "")


def place_in_rosrm(fault: BaseException) -> str:
    """Return file and line of the innermost frame of rosrm itself; "" if there is none."""
    return _innermost(_frames(fault), "rosrm")


def _place_in_plugin(fault: BaseException) -> str:
    """Return file and line of the plugin's own innermost frame; "" if rosrm raised the fault.

    The plugin may call libraries, so the package of the first frame outside rosrm is the plugin's.
    """
    frames = _frames(fault)
    own = next((package for package, _ in frames if package not in _LOADERS), "")
    return _innermost(frames, own) if own else ""


def _frames(fault: BaseException) -> list[tuple[str, str]]:
    """Return top-level package and place of each frame of a traceback, the innermost last."""
    return [
        (
            str(frame.f_globals.get("__name__", "?")).partition(".")[0],
            f"{frame.f_code.co_filename}:{line}",
        )
        for frame, line in walk_tb(fault.__traceback__)
    ]


def _innermost(frames: list[tuple[str, str]], package: str) -> str:
    return next((place for name, place in reversed(frames) if name == package), "")
