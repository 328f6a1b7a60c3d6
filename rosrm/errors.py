"""Errors of rosrm, with messages for the user."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import takewhile
from traceback import walk_stack, walk_tb
from types import FrameType
from typing import Final, NoReturn

from rosrm.wording import sanitized

#: Maximum number of characters of the text of an exception, and of a text that a plugin returns.
#: Receivers of messages accept many more, so a sentence with such a text never exceeds their
#: bounds.
LONGEST_TEXT: Final = 1_500
#: Maximum number of characters of the place of an exception.
_LONGEST_PLACE: Final = 500
#: Packages that load and call plugins; their frames are never frames of a plugin.
_LOADERS: Final = frozenset({
    "rosrm", "pkgutil", "importlib", "pluggy", "typer", "click", "contextlib", "dataclasses",
})  # fmt: skip


class RosrmError(Exception):
    """Error for the user: its text is the whole message, and no traceback is shown."""

    exit_code = 1


class ConfigError(RosrmError):
    """A file or an option is invalid; none of its values were used."""

    exit_code = 2


@contextmanager
def ros_needed() -> Iterator[None]:
    """Turn a failed import of ROS 2 into an error for the user.

    Raises:
        RosrmError: ROS 2 cannot be imported.
    """
    try:
        yield
    except ImportError as error:
        if not _is_of_ros(error):
            raise
        reason = str(error).splitlines()[0]
        raise RosrmError(
            f"ROS 2 cannot be imported ({reason}). Source your ROS 2 (and the workspace with "
            "rosrm_msgs), or install the wheels: pip install 'rosrm[ros]'"
        ) from None


def _is_of_ros(error: ImportError) -> bool:
    """Return True if a package of ROS was not found, or could not be loaded by `rosrm.ros`."""
    package = (error.name or "").partition(".")[0]
    modules = (frame.f_globals.get("__name__", "") for frame, _ in walk_tb(error.__traceback__))
    return package != "rosrm" and (
        package in {"rclpy", "rosrm_msgs"}
        or any(f"{one}.".startswith("rosrm.ros.") for one in modules)
    )


class PluginError(RosrmError):
    """A plugin cannot be imported, raised, hung or returned an invalid value.

    Attributes:
        was_raised: True: the text describes an exception of the plugin; False: it is rosrm's own.
    """

    was_raised = False


class Refused(RosrmError):
    """A valid request was refused; nothing was changed.

    Args:
        message: cause, place, allowed values and remedy.
        code: the reason in one word, as in `rosrm_msgs/Answer`.
    """

    def __init__(self, message: str, code: str = "invalid") -> None:
        super().__init__(message)
        self.code = code

    @property
    def may_pass(self) -> bool:
        """Return True if the same request may succeed later: the master cannot answer it now."""
        return self.code in ("failed", "journal")


class NoMaster(RosrmError):
    """No master answered in time."""

    exit_code = 3


class LaunchError(RosrmError):
    """A process cannot be started on this host; the text gives the reason.

    The first line is the reason; further lines have details, such as the PATH.
    """


class JournalError(RosrmError):
    """The journal cannot be read or written."""


class JournalBlocked(JournalError):
    """The journal cannot be written at the moment; nothing was changed, and a retry is safe.

    Args:
        message: text for the user who started the master.
        public: text for clients, without paths of the master's machine; "": the message.
    """

    def __init__(self, message: str, public: str = "") -> None:
        super().__init__(message)
        self.public = public or message


class RecordError(RosrmError):
    """A file is no recording, or the recording is damaged, cut short or of another version."""

    exit_code = 2


class SupervisorError(RosrmError):
    """The supervisor of this host cannot be started or reached."""


class TransferError(RosrmError):
    """A directory cannot be sent to another host or fetched from one; no partial copy remains."""


class LabError(RosrmError):
    """A virtual host or its network cannot be created, changed or found."""


class CriuError(RosrmError):
    """CRIU does not work on this host, or failed to dump or restore; the text gives the reason."""


class PortableError(RosrmError):
    """A portable node cannot be asked to leave or rejoin the ROS graph, or does not do so."""


class SkipPlugin(Exception):
    """Raised by a plugin's `create` if it is absent on this host; the text gives the reason."""


class PluginInterrupt(BaseException):
    """Interrupt of an overdue call of a plugin; no `Exception`, because plugins catch these.

    Attributes:
        place: file and line of the plugin that was interrupted; "": not known yet.
    """

    place = ""


class PluginTimeout(TimeoutError):
    """The call of a plugin took too long.

    Attributes:
        place: as in `PluginInterrupt`.
    """

    place = ""


# --- exceptions of plugins ----------------------------------------------------------------------


def describe_fault(fault: BaseException) -> str:
    """Return an exception in one printable line of bounded length: its type and its text.

    The exception may be a plugin's own, so both may raise, or be anything.
    """
    kind, text = _text_of(lambda: type(fault).__name__), _text_of(lambda: str(fault))
    return f"{kind}: {text}" if text else kind


def _text_of(read: Callable[[], object]) -> str:
    try:
        return plain_text(read())
    except BaseException:  # noqa: BLE001 - see `describe_fault`
        return ""


def plain_text(text: object, *, lines: bool = False) -> str:
    """Return a text of a plugin as a printable `str` of bounded length; "": it is no text.

    Args:
        text: may be of a subclass of `str`, whose methods are the plugin's.
        lines: True: newlines stay.
    """
    if not isinstance(text, str):
        return ""
    exact = str.__str__(text)[: LONGEST_TEXT * 2]
    return sanitized(exact if lines else " ".join(exact.split()), LONGEST_TEXT, lines=lines)


def describe_plugin_fault(fault: BaseException) -> str:
    """Return an exception in one line with the place in the plugin that raised it.

    The text of a `PluginError` is rosrm's own sentence, and is returned unchanged.
    """
    if type(fault) is PluginError:
        return str(fault)
    place = describe_place(fault)
    if type(fault) is PluginTimeout:
        fault = TimeoutError(*fault.args)
    return describe_fault(fault) + (f" ({place})" if place else "")


def describe_place(fault: BaseException) -> str:
    """Return the place in the plugin that raised an exception, printable and bounded; or ""."""
    return sanitized(_text_of(lambda: place_in_plugin(fault)), _LONGEST_PLACE)


def place_in_rosrm(fault: BaseException) -> str:
    """Return file and line of the innermost frame of rosrm; "" if there is none."""
    return _innermost(_frames(fault), "rosrm")


def place_in_plugin(fault: BaseException) -> str:
    """Return file and line of the plugin's own innermost frame; "" if rosrm raised the fault."""
    known = ""
    if type(fault) is PluginInterrupt or type(fault) is PluginTimeout:
        known = fault.place
    return known or _innermost_of_plugin(_frames(fault))


def place_in_stack(frame: FrameType | None, guard: FrameType | None) -> str:
    """Return file and line of the plugin's own innermost frame, of a running call; "": none.

    Args:
        frame: the innermost frame of the call.
        guard: the frame of rosrm that executes the call.
    """
    called = takewhile(lambda one: one[0] is not guard, walk_stack(frame)) if frame else ()
    return _innermost_of_plugin(_packages(called)[::-1])


def _innermost_of_plugin(frames: list[tuple[str, str]]) -> str:
    """Return the place of the plugin's own innermost frame.

    The plugin may call libraries, so the package of the first frame outside rosrm is the plugin's.
    """
    own = next((package for package, _ in frames if package not in _LOADERS), "")
    return _innermost(frames, own) if own else ""


def _frames(fault: BaseException) -> list[tuple[str, str]]:
    """Return top-level package and place of each frame of a traceback, the innermost last."""
    return _packages(walk_tb(fault.__traceback__))


def _packages(frames: Iterable[tuple[FrameType, int]]) -> list[tuple[str, str]]:
    return [
        (
            str(frame.f_globals.get("__name__", "?")).partition(".")[0],
            f"{frame.f_code.co_filename}:{line}",
        )
        for frame, line in frames
    ]


def _innermost(frames: list[tuple[str, str]], package: str) -> str:
    return next((place for name, place in reversed(frames) if name == package), "")


def assert_never(value: NoReturn) -> NoReturn:
    """Fail for a value that no branch handles; a type checker proves that there is none."""
    raise AssertionError(f"{value!r} is handled by no branch")
