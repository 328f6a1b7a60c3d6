"""Time-out of a plugin call, by the real-time interval timer of the process.

An alarm raises an exception in the plugin. A plugin may catch it in a loop. So from the second
alarm on, a trace function raises the exception again at the next line of each function, which is in
the `except` clause. Then the exception leaves the loop.
"""

from __future__ import annotations

import inspect
import logging
import os
import signal
import sys
import threading

# Without the conversion to enumerations, which takes most of the time of `signal.signal`.
from _signal import signal as install  # type: ignore[import-not-found]
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Final, TypeVar

from rosrm import clocks, threads
from rosrm.errors import PluginInterrupt, PluginTimeout, place_in_stack
from rosrm.extensions.plugin_calls import raise_alone

T = TypeVar("T")

#: Time-out of a call of a policy or strategy by the master, in seconds.
CALL_LIMIT: Final = 1.0
#: Seconds from the first alarm to the second one, because a plugin may catch the first one.
_AGAIN: Final = 0.05
#: Seconds between the further alarms. The trace function gets through one `try` of each function;
#: with several around each other, some alarm must come between them.
_SOON: Final = 0.001
#: Seconds between two looks for an overdue call that no alarm has interrupted.
_WATCH_PERIOD: Final = 0.5
#: Seconds between two log lines on a call that does not end.
_LOG_PERIOD: Final = 5.0

_log = logging.getLogger("rosrm.plugins")


def limited(seconds: float, call: Callable[[], T], late: Callable[[], str]) -> T:
    """Return the answer of a call; only in the main thread, which gets signals, it has a time-out.

    A loop inside C code that never returns to Python cannot be interrupted.

    Raises:
        TimeoutError: the call took too long, even if it returned; the text is that of `late`.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    _Watch.ensure()
    try:
        return _limited(seconds, call, late)
    except PluginInterrupt:  # of the watch, at the very end of the call
        raise PluginTimeout(late()) from None


def end_limit() -> None:
    """Stop interrupting the innermost call, which has ended; only in the main thread.

    Otherwise the functions that restore the process after the call would be interrupted, too.
    """
    if _Alarm.ringing is not None:
        _Alarm.ringing.stop()


def _limited(seconds: float, call: Callable[[], T], late: Callable[[], str]) -> T:
    alarm = _Alarm(inspect.currentframe(), clocks.awake_time() + seconds)
    outer, _Alarm.ringing = _Alarm.ringing, alarm
    # A process has one timer, so that of a test runner or of an outer limit is restored afterwards.
    before = install(signal.SIGALRM, _ring)
    left, interval = signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN)
    try:
        return call()
    finally:
        alarm.stop()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        _Alarm.ringing = outer
        # The default action is not restored, because it would end the process at a last late alarm.
        if callable(before) and before is not _ring:
            install(signal.SIGALRM, before)
        if left:
            signal.setitimer(signal.ITIMER_REAL, left, interval)
        if alarm.interrupt is not None:
            # Either has the place in the plugin at which the call was interrupted.
            fault = PluginTimeout(late()).with_traceback(alarm.interrupt.__traceback__)
            fault.place, alarm.interrupt = alarm.interrupt.place, None
            raise_alone(fault)


def _ring(number: int, frame: FrameType | None) -> None:
    """Pass the alarm on; the handler stays installed, so it must keep no call and no frame."""
    if _Alarm.ringing is not None:
        _Alarm.ringing.ring(number, frame)


#: Files of the guard, which restores what a late call has changed, so it is not interrupted.
_OWN: Final = frozenset({
    __file__, *(str(Path(__file__).with_name(f"{one}.py")) for one in ("guard", "process_state")),
})  # fmt: skip


def _is_own(frame: FrameType | None) -> bool:
    return frame is not None and frame.f_code.co_filename in _OWN


class _Alarm:
    """The interrupts of one call.

    Args:
        guard: the frame that executes the call; it is not interrupted itself.
        deadline: monotonic time of the first alarm.

    Attributes:
        ringing: that of the innermost running call.
        interrupt: the newest interrupt; None if the call ended in time.
        is_running: True until the call has ended.
    """

    ringing: ClassVar[_Alarm | None] = None

    def __init__(self, guard: FrameType | None, deadline: float) -> None:
        self.interrupt: PluginInterrupt | None = None
        self.deadline = deadline
        self._was_forced = False
        self._guard = guard
        self.is_running = True
        self._rung_at = self._logged_at = 0.0
        self._before = (sys.gettrace(), sys.getprofile())

    def stop(self) -> None:
        """Interrupt nothing from now on."""
        with _Watch.lock:
            self.is_running, self._guard = False, None  # the frame refers to this object
        if self.interrupt is not None:
            sys.settrace(self._before[0])
            sys.setprofile(self._before[1])

    def ring(self, _signal: int, frame: FrameType | None) -> None:
        """Interrupt the call: handle the signal of the timer."""
        if not self.is_running or _is_own(frame):  # the call ended at the last moment
            return
        sys.settrace(None)
        sys.setprofile(None)
        if self.interrupt is not None:  # the plugin caught it
            self._log_place(frame)
            self._trace_from(frame)
            signal.setitimer(signal.ITIMER_REAL, _SOON, _SOON)
        self._rung_at = self._rung_at or clocks.awake_time()
        raise self._next_interrupt()

    def force(self) -> None:
        """Interrupt an overdue call from another thread, because its alarm was disabled."""
        main = threading.main_thread().ident or 0
        handler = signal.getsignal(signal.SIGALRM)
        if handler is not _ring or self._was_forced:  # it may also be blocked
            self._next_interrupt()
            interrupt_thread(main)
        self._was_forced = True
        if callable(handler):  # ends a blocking call; the default action would end the process
            signal.pthread_kill(main, signal.SIGALRM)

    def _next_interrupt(self) -> PluginInterrupt:
        new = PluginInterrupt("a plugin was interrupted, because its call took too long")
        if self.interrupt is not None:  # the end of an object of the plugin may be late, too
            new.place = self.interrupt.place
        self.interrupt = new
        return new

    def _log_place(self, frame: FrameType | None) -> None:
        now = clocks.awake_time()
        if now - self._logged_at < _LOG_PERIOD:
            return
        self._logged_at = now
        _log.warning(
            "a plugin catches its interrupt, and has not returned %.1f s after its time limit; "
            "it is interrupted again at %s",
            now - self._rung_at, place_in_stack(frame, self._guard) or "an unknown place",
        )  # fmt: skip

    def _trace_from(self, frame: FrameType | None) -> None:
        """Interrupt the call at the next line of this frame, of a callee, or of its callers."""
        sys.settrace(self._trace)
        # Python ends the tracing when the trace function raises, and a caller may catch that, too.
        sys.setprofile(self._profile)
        while frame is not None and frame is not self._guard:
            frame.f_trace = self._trace
            frame = frame.f_back

    def _trace(self, frame: FrameType, event: str, _argument: Any) -> Any:
        if not self.is_running or _is_own(frame):
            return None
        if event == "line":
            raise self._next_interrupt()
        return self._trace

    def _profile(self, frame: FrameType, event: str, _argument: Any) -> None:
        if event == "return" and self.is_running:
            self._trace_from(frame.f_back)


class _Watch:
    """Thread that interrupts an overdue call whose plugin has disabled the alarm."""

    lock: ClassVar[threading.Lock] = threading.Lock()
    _pid: ClassVar[int] = 0

    @classmethod
    def ensure(cls) -> None:
        """Start the thread, unless this process has it already."""
        if cls._pid != os.getpid():
            cls._pid, cls.lock = os.getpid(), threading.Lock()
            threads.start(cls._watch, "rosrm-plugins", again=True)

    @classmethod
    def _watch(cls) -> None:
        tick = threading.Event()
        while not tick.wait(_WATCH_PERIOD):
            alarm = _Alarm.ringing
            if alarm is None or clocks.awake_time() < alarm.deadline + _WATCH_PERIOD:
                continue
            with cls.lock:
                if alarm.is_running:
                    alarm.force()
            del alarm


def interrupt_thread(ident: int) -> None:
    """Raise an exception in a thread at its next line of Python; a blocking call is not ended."""
    import ctypes  # noqa: PLC0415 - seldom needed, and the runtimes' memory is budgeted

    ctypes.pythonapi.PyThreadState_SetAsyncExc(
        ctypes.c_ulong(ident), ctypes.py_object(PluginInterrupt)
    )
