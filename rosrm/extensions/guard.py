"""Guard of every call of a plugin: a time-out, any exception, and the state of the process.

`PluginCalls.ask` adds the record of a part. A test fails for any other call of a plugin.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Final, NamedTuple, Protocol, TypeVar

from rosrm.errors import PluginError
from rosrm.extensions.plugin_calls import Answers, Plugin, contained, raise_alone, raised, titled
from rosrm.extensions.process_state import Interrupts, ProcessState
from rosrm.extensions.time_limit import CALL_LIMIT, end_limit, limited
from rosrm.wording import listed

T = TypeVar("T")

#: Time-out of the import of a plugin, of a hook and of `create`; seconds. Below the lease of a
#: host, because a slave that restarts loads its plugins before it renews the lease. (A slave does
#: not wait that long for `create`, see `rosrm.slave.plugin_creation`.)
LOADING_LIMIT: Final = 8.0


class Crash(NamedTuple):
    """A call in which a former process ended.

    Attributes:
        whom: the plugin, as "probe 'x'".
        text: a sentence on the end.
    """

    whom: str
    text: str


class Notes(Protocol):
    """Notes of the running calls; a part keeps them in a file (`rosrm.runtime.crash_notes`)."""

    def reason(self, whom: str, hook: str) -> str:
        """Return why a plugin's method is not called; "": it is."""

    def begin(self, whom: str, hook: str) -> int:
        """Note a call that begins; return its slot, 0 for none."""

    def end(self, slot: int) -> None:
        """Remove the note of a call."""

    def note_versions(self, versions: Mapping[str, str]) -> None:
        """Note the distribution of each plugin, by its name as in the notes."""


_notes: Notes | None = None


def keep_notes(notes: Notes | None) -> None:
    """Keep these notes of all calls in this process from now on."""
    global _notes  # noqa: PLW0603 - a process has one
    _notes = notes


def note_versions(versions: Mapping[str, str]) -> None:
    """Note the distribution of each plugin, by its name as in the notes."""
    if _notes is not None:
        _notes.note_versions(versions)


_log = logging.getLogger("rosrm.plugins")


def guarded(
    call: Callable[[], T], *, whom: str, hook: str = "", seconds: float = LOADING_LIMIT,
    late: Callable[[], str] | None = None, of: object = None, lets: Answers = (),
) -> T:  # fmt: skip
    """Return the answer of plugin code, which may do anything but end the process.

    Args:
        call: calls the plugin and checks the answer; raises `PluginError` for an invalid one.
        whom: the plugin, as "probe 'x'".
        hook: the called method or function, for messages.
        seconds: time-out; it holds in the main thread alone, so other threads watch themselves.
        late: returns the text about a time-out.
        of: object with the method.
        lets: as in `contained`.

    Raises:
        PluginError: the call failed, or the plugin is left out.
    """
    text = late or partial("it took longer than {:g} s".format, seconds)
    inner = partial(contained, call, of=of, hook=hook, lets=lets)
    try:
        return limited(seconds, partial(in_process, whom, hook, inner), text)
    except TimeoutError as fault:
        error = raised(fault)
    return raise_alone(error)


def limit_of_one_call(plugin: Plugin, call: Callable[[], T]) -> T:
    """Execute a call for `PluginCalls` with a time-out; master and slave set `Deadlines`."""
    late = f"it took longer than {CALL_LIMIT:g} s"
    return limited(CALL_LIMIT, partial(in_process, titled(*plugin), "", call), lambda: late)


def in_process(whom: str, hook: str, call: Callable[[], T], *, often: bool = False) -> T:
    """Call a plugin; note whom, and restore what it changed in the process.

    Args:
        often: True: as `whole=False` of `ProcessState`.
    """
    left_out = "" if _notes is None else _notes.reason(whom, hook)
    if left_out:
        raise PluginError(left_out)
    slot, pid = 0 if _notes is None else _notes.begin(whom, hook), os.getpid()
    try:
        if threading.current_thread() is not threading.main_thread():
            return _called(call, lambda: False)  # Ctrl-C interrupts only the main thread
        before, interrupts = ProcessState(whole=not often), Interrupts()
        try:
            return _called(call, lambda: interrupts.pressed)
        finally:
            end_limit()
            interrupts.end()
            changed = contained(before.restore)  # what a plugin left may be of any type
            if changed and logging.getLogger().handlers:  # a command has no log
                _say_changed(" ".join(filter(None, (whom, hook))), listed(changed))
    finally:
        if (
            os.getpid() != pid
        ):  # a fork of the plugin, which would continue as a second master or slave
            os._exit(1)
        if _notes is not None:
            _notes.end(slot)


@lru_cache(maxsize=1_000)  # once, because a policy may do so in each of a thousand calls
def _say_changed(whom: str, changed: str) -> None:
    _log.warning("%s has changed %s, restored now", whom, changed)


def _called(call: Callable[[], T], is_users: Callable[[], bool]) -> T:
    try:
        return call()
    except KeyboardInterrupt as fault:
        if is_users():
            raise
        error = raised(fault)
    return raise_alone(error)
