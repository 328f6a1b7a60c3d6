"""The guard of calls of plugins: a plugin that misbehaves makes only that call fail."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import socket
import sys
import threading
import time
import warnings
import xmlrpc.client
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosrm.errors import ConfigError, PluginError, SkipPlugin
from rosrm.extensions.answers import whole
from rosrm.extensions.discovery import definition
from rosrm.extensions.guard import guarded
from rosrm.extensions.plugin_calls import Answers, PluginCalls, required
from rosrm.extensions.plugin_deadline import Deadlines
from rosrm.extensions.process_state import ProcessState
from rosrm.runtime.crash_notes import kept_notes

PLUGIN = ("filter", "odd")
#: Letters of the longest text that any message of rosrm accepts, many times over.
LONG = "x" * 3_000_000


class Unspeakable(Exception):
    """An error that does not give its text."""

    def __str__(self) -> str:
        raise KeyboardInterrupt

    __repr__ = __str__


class Base(BaseException):
    """An error that is no `Exception`."""


class Odd(str):
    """A text with methods of its own."""

    __slots__ = ()

    def __getitem__(self, _at: object) -> str:
        raise Base

    split = encode = isprintable = __getitem__  # type: ignore[assignment]


class Speaking(Exception):
    def __str__(self) -> str:
        return Odd("a\ud800b\x1b[31m\x00" + LONG)


ERRORS: list[BaseException] = [
    ValueError("no"), Base("no"), SystemExit(3), GeneratorExit(), KeyboardInterrupt(),
    asyncio.CancelledError(), StopIteration(), MemoryError(), RecursionError(), Unspeakable(),
    Speaking(), ValueError(LONG), ValueError("\ud800\x1b[2J\n"), PluginError(LONG),
    TimeoutError("mine"), ConfigError("no"), SkipPlugin("no"), OSError(5, "no"),
    type("n" * 100_000, (Exception,), {})("long name"),
]  # fmt: skip


def _by_guard(call: Callable[[], Any], lets: Answers = ()) -> Any:
    return guarded(call, whom="filter 'odd'", hook="mask", lets=lets)


def _by_ask(call: Callable[[], Any], lets: Answers = ()) -> Any:
    calls = PluginCalls(Deadlines(5.0))
    try:
        return calls.ask(*PLUGIN, "mask", call, lets=lets)
    finally:
        ((plugin, error),) = calls.changes(0.0)
        assert plugin == PLUGIN
        assert _is_plain(error)


def _by_deadline(call: Callable[[], Any]) -> Any:
    return PluginCalls(Deadlines(5.0)).ask(*PLUGIN, "mask", call)


def _by_thread(call: Callable[[], Any], lets: Answers = ()) -> Any:
    """Call a plugin in a thread, as a probe, an executor or a sink."""
    outcome: list[BaseException] = []

    def run() -> None:
        try:
            _by_guard(call, lets)
        except BaseException as fault:  # noqa: BLE001 - raised in the test
            outcome.append(fault)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(10.0)
    raise outcome[0]


def _is_plain(text: str) -> bool:
    return text.isprintable() and len(text) < 5_000 and bool(text.encode())


@pytest.mark.parametrize("way", [_by_guard, _by_ask, _by_thread])
@pytest.mark.parametrize("error", ERRORS, ids=lambda one: type(one).__name__[:20])
def test_whatever_a_plugin_raises_costs_one_call(error: BaseException, way: Any) -> None:
    """Each exception becomes a `PluginError` with a printable text of bounded length."""

    def fail() -> None:
        raise error

    with pytest.raises(PluginError) as caught:
        way(fail)
    assert _is_plain(str(caught.value))


class Unclassified(Exception):
    """An error whose class is a property that raises."""

    @property
    def __class__(self) -> Any:
        raise Base

    @__class__.setter
    def __class__(self, _kind: object) -> None:
        """Do nothing."""


@pytest.mark.parametrize("way", [_by_guard, _by_ask, _by_thread])
def test_an_error_that_hides_its_class_is_contained_beside_answers_by_contract(way: Any) -> None:
    """`isinstance` reads `__class__` of an exception, which runs code of the plugin."""

    def fail() -> None:
        raise Unclassified

    with pytest.raises(PluginError, match="Unclassified"):
        way(fail, lets=(ValueError,))


class Connection:
    """An object of a plugin whose end blocks."""

    ended: float = 0.0

    def __del__(self) -> None:
        Connection.ended = time.monotonic()
        while time.monotonic() < Connection.ended + 20.0:
            time.sleep(0.01)


def _fail() -> None:
    _kept = Connection()
    raise ValueError("no")


def _hang() -> None:
    _kept = Connection()
    while True:
        time.sleep(0.01)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("fail", [_fail, _hang])
def test_the_objects_of_a_call_that_failed_end_within_its_time_out(
    fail: Callable[[], None],
) -> None:
    """The end of a connection may block, and nothing would interrupt it after the guard."""
    began = time.monotonic()
    Connection.ended = 0.0
    with pytest.raises(PluginError, match=rf"{__file__}:\d+") as caught:
        PluginCalls(Deadlines(0.3)).ask(*PLUGIN, "mask", fail)
    assert Connection.ended > 0.0
    del caught
    assert time.monotonic() - began < 10.0


def test_a_fault_names_file_and_line_of_the_plugin() -> None:
    """The place is the plugin's own, not that of the guard."""

    def fail() -> None:
        raise Base("no")

    place = f"{__file__}:{fail.__code__.co_firstlineno + 1}"
    with pytest.raises(PluginError, match=rf"Base: no \({place}\)"):
        _by_guard(fail)


def test_the_ctrl_c_of_the_user_ends_a_command() -> None:
    """A `KeyboardInterrupt` by SIGINT is no fault of the plugin that runs at that moment."""
    with pytest.raises(KeyboardInterrupt):
        _by_guard(lambda: os.kill(os.getpid(), signal.SIGINT))


def test_an_answer_by_contract_is_no_fault_and_bounded() -> None:
    """An exception that the contract names passes with a bounded text, as its own class."""

    class Absent(SkipPlugin):
        """A class of the plugin."""

    def skip() -> None:
        raise Absent("a\ud800" + LONG)

    with pytest.raises(SkipPlugin) as caught:
        guarded(skip, whom="probe 'odd'", lets=(SkipPlugin,))
    assert type(caught.value) is SkipPlugin
    assert _is_plain(str(caught.value))


def test_a_text_of_a_plugin_is_bounded_and_printable() -> None:
    """A reason is cut, and loses what a terminal or a message cannot hold; newlines stay."""
    assert required("two\nlines", str) == "two\nlines"
    assert required(Odd("a\x1bb"), str) == "a?b"
    assert _is_plain(required("\ud800" + LONG, str))


def _ignore(*_: object) -> None:
    """Handle a signal."""


def _take_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM):
        signal.signal(number, _ignore)


def _configure_the_log() -> None:
    logging.getLogger("rosrm.plugins").disabled = True  # as `dictConfig` does by default


HARM: dict[str, Callable[[], Any]] = {
    "signals": _take_signals,
    "ignored": lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN),
    "umask": lambda: os.umask(0),
    "directory": lambda: os.chdir("/"),
    "blocked signals": lambda: signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals()),
    "switch interval": lambda: sys.setswitchinterval(100.0),
    "recursion": lambda: sys.setrecursionlimit(5_000),
    "collection": gc.disable,
    "sockets": lambda: socket.setdefaulttimeout(0.001),
    "numpy": lambda: np.seterr(all="raise"),
    "disabled log": lambda: logging.disable(logging.CRITICAL),
    "level of the log": lambda: logging.getLogger().setLevel(logging.CRITICAL),
    "handlers of the log": logging.getLogger().handlers.clear,
    "configuration of the log": _configure_the_log,
    "thresholds of the collection": lambda: gc.set_threshold(0),
    "debugging of the collection": lambda: gc.set_debug(gc.DEBUG_SAVEALL),
    "environment": lambda: os.environ.update(CUDA_VISIBLE_DEVICES="7", PATH="/odd"),
    "smaller environment": lambda: os.environ.pop("PATH"),
    "warnings that raise": lambda: warnings.simplefilter("error"),
}


def _state() -> tuple[object, ...]:
    mask = os.umask(0o077)
    os.umask(mask)
    root = logging.getLogger()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.getsignal(one) for one in numbers]
    settings = (
        sys.getswitchinterval(), sys.getrecursionlimit(), gc.isenabled(),
        socket.getdefaulttimeout(), np.geterr(), signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        gc.get_threshold(), gc.get_debug(), "error" in [one[0] for one in warnings.filters],
        logging.getLogger("rosrm.plugins").disabled, dict(os.environ),
    )  # fmt: skip
    return (
        settings,
        mask,
        Path.cwd(),
        root.manager.disable,
        root.level,
        root.handlers[:],
        handlers,
    )


@pytest.mark.parametrize("harm", HARM)
def test_what_a_plugin_changes_in_the_process_is_restored(
    harm: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Signals, log, umask and further settings are as before the call, and a warning says so."""
    before = _state()
    guarded(HARM[harm], whom=f"filter {harm!r}", hook="mask")
    assert _state() == before
    assert "has changed" in caplog.text


@pytest.mark.parametrize("harm", HARM)
def test_what_a_plugin_changes_in_a_decision_is_restored_within_a_second(harm: str) -> None:
    """The loop restores once a second the state whose restoration costs system calls."""
    before, state = _state(), ProcessState()
    _by_deadline(HARM[harm])
    state.restore()
    assert _state() == before


def test_a_thread_may_change_the_environment_while_it_is_restored() -> None:
    """A library that sets a variable for the time of a call does so again and again."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    state, is_over = ProcessState(), threading.Event()
    end = time.monotonic() + 30.0
    names = [f"ROSRM_TEST_OF_THREAD_{number}" for number in range(200)]

    def set_and_remove() -> None:
        for _ in range(1_000):
            for name in names:
                os.environ[name] = "1"
            for name in names:
                with contextlib.suppress(KeyError):  # rosrm has removed it
                    del os.environ[name]
        is_over.set()

    thread = threading.Thread(target=set_and_remove)
    thread.start()
    try:
        while not is_over.is_set() and time.monotonic() < end:
            state.restore()
    finally:
        thread.join(30.0)
        sys.setswitchinterval(interval)
        state.restore()


class _Unequal:
    """Handler of a signal that no code may compare."""

    def __call__(self, *_: object) -> None:
        """Handle a signal."""

    def __eq__(self, _other: object) -> bool:
        raise ZeroDivisionError("a bug")

    __hash__ = object.__hash__


@pytest.mark.parametrize(
    "harm",
    [
        lambda: signal.signal(signal.SIGHUP, _Unequal()),
        lambda: setattr(logging.getLogger(), "handlers", ()),
        lambda: setattr(logging.getLogger(), "handlers", None),
    ],
    ids=["signal", "tuple of handlers", "no handlers"],
)
def test_what_a_plugin_leaves_in_other_types_is_restored(
    harm: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The restoration relies on nothing that the plugin has set."""
    root, handler = logging.getLogger(), signal.getsignal(signal.SIGHUP)
    monkeypatch.setattr(root, "handlers", root.handlers)
    before = _state()
    try:
        guarded(harm, whom="filter 'odd'")
        assert _state() == before
    finally:
        signal.signal(signal.SIGHUP, handler)


def test_what_cannot_be_restored_costs_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of the restoration is one of the plugin, and ends no part."""

    class Log(list[Any]):
        def __ne__(self, _other: object) -> bool:
            raise ZeroDivisionError("a bug")

    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", root.handlers)
    with pytest.raises(PluginError, match="a bug"):
        guarded(lambda: setattr(root, "handlers", Log()), whom="filter 'odd'")


def test_what_rosrm_has_changed_itself_stays() -> None:
    """The end of the start sets the thresholds of the collection for the time of the service."""
    state, before = ProcessState(), gc.get_threshold()
    gc.set_threshold(12_345)
    try:
        state.keep_own()
        assert state.restore() == []
        assert gc.get_threshold()[0] == 12_345
    finally:
        gc.set_threshold(*before)


def test_a_plugin_that_changes_the_process_in_each_call_is_named_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A policy that sets the errors of numpy in each call fills no disk with warnings."""
    calls = PluginCalls(Deadlines(5.0))
    for _ in range(20):
        calls.ask("scoring", "numeric", "score", lambda: np.seterr(all="ignore"))
    (said,) = caplog.messages
    assert said.startswith("scoring policy 'numeric' has changed the errors of numpy")


def test_a_method_of_any_kind_costs_one_call() -> None:
    """The place of a method is unknown if it is an object that has every attribute."""
    endless = xmlrpc.client.ServerProxy("http://127.0.0.1:1").read
    assert definition(endless) == ""

    class Remote:
        read = endless

    with pytest.raises(PluginError, match="answered a int"):
        guarded(lambda: required(3, str), whom="probe 'remote'", hook="read", of=Remote())


def _endless() -> None:
    while True:
        pass


def _endless_without_alarm() -> None:
    signal.signal(signal.SIGALRM, _ignore)
    _endless()


def _endless_without_signals() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    _endless()


def _endless_without_timer() -> None:
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    time.sleep(60.0)


@pytest.fixture
def _own_timer() -> Iterator[None]:
    """Restore the timer of the test runner, which the tested plugins take."""
    left = signal.setitimer(signal.ITIMER_REAL, 0.0)
    yield
    signal.setitimer(signal.ITIMER_REAL, *left)


@pytest.mark.usefixtures("_own_timer")
@pytest.mark.parametrize(
    "hang", [_endless, _endless_without_alarm, _endless_without_timer, _endless_without_signals]
)
def test_the_limit_holds_although_a_plugin_takes_its_signal(hang: Callable[[], None]) -> None:
    """A call ends after its limit, also if the plugin replaces the alarm or stops the timer."""
    began = time.monotonic()
    with pytest.raises(PluginError, match="took longer than"):
        guarded(hang, whom="filter 'odd'", seconds=0.2)
    assert time.monotonic() - began < 20.0


@pytest.mark.usefixtures("_own_timer")
def test_what_a_plugin_that_catches_its_interrupts_has_changed_is_restored(tmp_path: Path) -> None:
    """The interrupts end before the process is restored and the note of the call is removed."""

    def stubborn() -> None:
        signal.signal(signal.SIGTERM, _ignore)
        os.umask(0)
        until = time.monotonic() + 0.2
        while time.monotonic() < until:
            try:
                while time.monotonic() < until:
                    pass
            except BaseException:  # noqa: BLE001 - such plugins exist
                pass

    before = _state()
    with kept_notes(tmp_path):
        for _ in range(3):
            with pytest.raises(PluginError, match="took longer than"):
                guarded(stubborn, whom="filter 'odd'", hook="mask", seconds=0.01)
            assert _state() == before
        (notes,) = tmp_path.glob("plugin-calls.*")
        assert b"filter" not in notes.read_bytes()


def test_a_plugin_that_is_often_slow_is_not_called_for_a_while() -> None:
    """Calls that are not late, but hold the loop again and again, begin a pause, too."""
    calls = PluginCalls(Deadlines(0.3, pause=60.0))

    def slow_calls() -> None:
        for _ in range(12):
            calls.ask(*PLUGIN, "mask", lambda: time.sleep(0.2))

    with pytest.raises(PluginError, match="not asked again"):
        slow_calls()


def test_a_plugin_holds_one_turn_of_the_loop_for_a_bounded_time() -> None:
    """A thousand calls of which none is slow would take longer together than a lease."""
    deadlines = Deadlines(0.3, pause=60.0)
    calls = PluginCalls(deadlines)

    def turn(number: int) -> None:
        deadlines.begin_turn()
        for _ in range(number):
            calls.ask("filter", "odd", "mask", lambda: time.sleep(0.03))

    for _ in range(3):
        turn(20)
    with pytest.raises(PluginError, match="not asked again for 60 s"):
        turn(100)


def test_a_call_in_a_thread_takes_no_limit_from_a_call_of_the_loop() -> None:
    """The thread of a start asks a strategy or launcher while the loop asks it, too."""
    calls = PluginCalls(Deadlines(0.3))
    begun, ended = threading.Event(), threading.Event()

    def in_thread() -> None:
        def wait() -> None:
            begun.set()
            assert ended.wait(30.0), "the call of the loop has not ended"

        calls.ask("launcher", "odd", "prepare", wait)

    def hang() -> None:
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            time.sleep(0.01)

    thread = threading.Thread(target=in_thread)
    thread.start()
    assert begun.wait(30.0), "the thread has not called the plugin"
    try:
        with pytest.raises(PluginError, match=r"took longer than 0\.3 s"):
            calls.ask("launcher", "odd", "leads", hang)
    finally:
        ended.set()
        thread.join(30.0)


def test_calls_in_threads_begin_no_pause() -> None:
    """Many starts ask a strategy in threads, which wait for each other but hold no loop."""
    calls = PluginCalls(Deadlines(0.02, pause=60.0))

    def in_thread() -> None:
        for _ in range(3):
            calls.ask(*PLUGIN, "mask", lambda: time.sleep(0.1))

    thread = threading.Thread(target=in_thread)
    thread.start()
    thread.join(30.0)
    assert calls.ask(*PLUGIN, "mask", lambda: 7) == 7


def test_quick_calls_begin_no_pause() -> None:
    """A policy that decides quickly may decide as often as the master asks."""
    calls = PluginCalls(Deadlines(5.0, pause=60.0))
    for _ in range(2_000):
        assert calls.ask(*PLUGIN, "mask", lambda: 7) == 7


def test_calls_leave_nothing_in_memory() -> None:
    """Thousands of guarded calls, good and bad, leave neither objects nor memory."""
    left = signal.setitimer(signal.ITIMER_REAL, 0.0)
    calls = PluginCalls(Deadlines(5.0))

    def both(number: int) -> None:
        for _ in range(number):
            calls.ask(*PLUGIN, "mask", int)
            with pytest.raises(PluginError):
                calls.ask(*PLUGIN, "mask", lambda: 1 // 0)
            calls.changes(time.monotonic())

    both(200)
    gc.collect()
    objects, memory = len(gc.get_objects()), _memory()
    both(2_000)
    gc.collect()
    signal.setitimer(signal.ITIMER_REAL, *left)
    assert len(gc.get_objects()) - objects < 500
    assert _memory() - memory < 4_096


def _memory() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


@pytest.mark.parametrize("hint", [Sequence[int], AbstractSet[int], tuple[int, ...]])
def test_an_answer_of_any_length_costs_no_memory(hint: Any) -> None:
    """A range counts as a sequence of all its numbers, and any class may claim a length."""

    class Long(tuple):  # type: ignore[type-arg] # noqa: SLOT001
        def __len__(self) -> int:
            return 1 << 62

    for answer in (range(1 << 62), Long((1, "x"))):
        with pytest.raises(PluginError):
            whole(answer, hint)
