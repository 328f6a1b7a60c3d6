"""`run_portable`: runs a portable node, which leaves and rejoins at rosrm's request."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import uninstall_signal_handlers

from rosrm import clocks
from rosrm.errors import PortableError
from rosrm.ros import fast_dds_relocation
from rosrm.ros.graph_remains import what_is_left
from rosrm_criu.control.listener import Listener
from rosrm_criu.control.messages import SIGNAL, VARIABLE, Request, State, Status, Want
from rosrm_criu.node.graph_departure import Departure, have_acknowledged, sees_again
from rosrm_criu.node.portable import PortableNode

#: Seconds between two reads of the request file: while the node runs, and while it is away. The
#: first also wakes an idle node; a busy one notices the signal after its callback.
_LOOK: Final = 0.25
_LOOK_AWAY: Final = 0.002
#: Signals that end a process; rclpy handles them while there is a context.
_ENDING: Final = (signal.SIGINT, signal.SIGTERM)
#: Seconds for the neighbours to announce themselves to a participant that can hear them.
_GREETED: Final = 0.3
#: Most attempts to enter. After that, a missing peer may have left, and others may see the node.
_ENTRIES: Final = 4
#: Most seconds for which callbacks continue until all readers have acknowledged: more than two
#: periods of the heartbeat (0.1 s).
_ACKNOWLEDGED: Final = 0.25
#: Seconds for pending work of callbacks (threads, coroutines) to end.
_REST: Final = 5.0


def run_portable(
    make: Callable[[], PortableNode],
    *,
    args: Sequence[str] | None = None,
    executor: Callable[[], Executor] = SingleThreadedExecutor,
    patience: float = 2.0,
) -> None:
    """Run a node until the process receives a signal to end; call this last, in the main thread.

    Without rosrm this is `rclpy.init`, creation of the node and `rclpy.spin`. Under rosrm, the node
    leaves the ROS graph between two callbacks on request, and rejoins on request.

    Args:
        make: returns the node, a `PortableNode`; called once.
        args: command line; None: the process's own.
        executor: creates the executor of the callbacks, again after each migration.
        patience: seconds to wait after a migration, before callbacks run again, until the node has
            matched as many readers and writers of its topics as before.

    Raises:
        PortableError: the node cannot rejoin, or its control directory cannot be used.
        TypeError: the constructor of the node creates an entity that belongs into `join`.
        Exception: raised by a callback.
    """
    given = list(sys.argv if args is None else args)
    directory = os.environ.get(VARIABLE, "")
    run = _Run(given, executor, patience, Path(directory) if directory else None)
    try:
        run.begin(make)
        run.until_the_end()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception as error:
        if run.was_ended_in(error):
            return
        run.say_failed(error)
        raise
    finally:
        run.end()


class _Ended(Exception):
    """The process received a signal to end while its node was away."""


class _Run:
    """A portable node in its process."""

    def __init__(
        self,
        args: list[str],
        make_executor: Callable[[], Executor],
        patience: float,
        directory: Path | None,
    ) -> None:
        self._args = args
        self._make_executor = make_executor
        self._patience = patience
        self._listener = None if directory is None else Listener(directory)
        self._woken = False
        self._looked = 0.0
        self._node: Any = None
        self._is_in = False  # the node is in the graph
        self._signals: dict[int, Any] = {}  # rclpy's handlers, while replaced: the node is away
        self._executor: Any = None
        if self._listener is not None:
            signal.signal(SIGNAL, self._wake)

    def _wake(self, *_: object) -> None:
        """Note the signal, and do no more: it may come between any two steps of the main thread."""
        self._woken = True

    # --- the course of a life --------------------------------------------------------------

    def begin(self, make: Callable[[], PortableNode]) -> None:
        """Join for the first time."""
        rclpy.init(args=self._args)
        self._node = make()
        self._is_in = True
        self._node._portable_join_first()  # noqa: SLF001 - the other half of one thing
        self._add_executor()
        if self._listener is not None:
            self._listener.report(Status(State.RUNNING))

    def until_the_end(self) -> None:
        """Run, leave, wait and rejoin, until the context is shut down."""
        with contextlib.suppress(_Ended):
            while (request := self._spin()) is not None:
                departure, fault = self._leave(request)
                if not fault:
                    request = self._wait_away()
                self._join(request, departure, fault)

    def end(self) -> None:
        """Shut down; keep the control directory of a failed node, whose status has the fault."""
        if self._is_in:
            self._node.destroy_node()
        if self._executor is not None:
            self._executor.shutdown()
        rclpy.try_shutdown()
        if self._listener is not None and self._listener.status.state is not State.FAILED:
            self._listener.close()

    def was_ended_in(self, error: Exception) -> bool:
        """Return True if the error came from a signal that shut the context down in a callback."""
        return isinstance(error, RCLError) and self._is_in and not rclpy.ok()

    def say_failed(self, error: Exception) -> None:
        """Report the failure to waiting clients; the traceback is in the log."""
        if self._listener is not None:
            message = str(error) if isinstance(error, PortableError) else _described(error)
            self._listener.report(Status(State.FAILED, self._listener.status.request, message))

    # --- running ---------------------------------------------------------------------------

    def _add_executor(self) -> None:
        self._executor = self._make_executor()
        self._executor.add_node(self._node)

    def _spin(self) -> Request | None:
        """Run callbacks until the node is to leave; None: the context is shut down."""
        timeout = None if self._listener is None else _LOOK
        while self._executor.context.ok():
            self._executor.spin_once(timeout_sec=timeout)
            request = self._asked()
            if request is not None:
                return request
        return None

    def _asked(self) -> Request | None:
        now = clocks.boot_time()
        if self._listener is None or not (self._woken or now >= self._looked + _LOOK):
            return None
        self._looked, self._woken = now, False
        return self._listener.next_request()

    # --- leaving ---------------------------------------------------------------------------

    def _leave(self, request: Request) -> tuple[Departure | None, str]:
        """Leave the graph; return the node's state, and why it cannot stay away ("": it can).

        If that is known in advance, the node does not leave, and no state is returned.
        """
        began = clocks.boot_time()
        listener = self._its_listener()
        listener.report(Status(State.LEAVING, request.id))
        try:
            fast_dds_relocation.check()
            self._run_until_acknowledged()
            self._come_to_rest()
        except PortableError as error:
            return None, str(error)
        departure, fault = self._depart()
        fault = fault or _not_clean()
        if not fault:
            seconds = {"leave": round(clocks.boot_time() - began, 6)}
            listener.report(Status(State.LEFT, request.id, seconds=seconds))
        return departure, fault

    def _run_until_acknowledged(self) -> None:
        """Run callbacks until all readers have acknowledged, so that the departure does not wait.

        Readers acknowledge only after the next heartbeat of their writer (0.1 s). If the node
        waited for that in its departure, it would be silent for that time.
        """
        deadline = clocks.boot_time() + _ACKNOWLEDGED
        while not have_acknowledged(self._node) and clocks.boot_time() < deadline:
            self._executor.spin_once(timeout_sec=0.002)

    def _come_to_rest(self) -> None:
        """Wait for the end of pending callbacks, so that the departure interrupts none."""
        deadline = clocks.boot_time() + _REST
        while unfinished := _unfinished(self._executor):
            if clocks.boot_time() > deadline:
                raise PortableError(
                    f"{len(unfinished)} callbacks have begun and not ended in {_REST:g} s (async "
                    f"functions that wait, or goals that are executed); the node stays as it was"
                )
            if any(one.executing() for one in unfinished):
                time.sleep(0.001)  # runs in another thread; rclpy offers nothing to wait on
            else:
                self._executor.spin_once(timeout_sec=0.01)

    def _depart(self) -> tuple[Departure | None, str]:
        node = self._node
        departure, fault = node._portable_leave()  # noqa: SLF001 - the other half of one thing
        self._is_in = False
        ended = not self._executor.context.ok()  # by a signal, which ROS handles up to here
        self._executor.shutdown()
        self._executor = None
        rclpy.try_shutdown()
        if ended:
            raise _Ended
        uninstall_signal_handlers()  # they need a context; until the rejoin, `_end` is used
        self._signals = {one: signal.signal(one, _end) for one in _ENDING}
        return departure, fault

    def _give_signals_back(self) -> None:
        for one, handler in self._signals.items():
            signal.signal(one, handler)
        self._signals = {}

    # --- away ------------------------------------------------------------------------------

    def _wait_away(self) -> Request:
        """Wait without any ROS entity, until the node is to rejoin."""
        listener = self._its_listener()
        while True:
            request = listener.next_request()
            if request is not None and request.want is Want.JOIN:
                return request
            # Not SimpleQueue.get, filled by a signal handler: if its timeout passes while the
            # process is dumped, CPython before 3.13 waits for ever after the restore.
            time.sleep(_LOOK_AWAY)

    # --- joining ---------------------------------------------------------------------------

    def _join(self, request: Request, departure: Departure | None, fault: str) -> None:
        """Rejoin: on request, or because the node cannot leave.

        Args:
            request: the request that this answers.
            departure: the node's state at its departure; None: it never left.
            fault: why it cannot leave; "": it had left.
        """
        listener = self._its_listener()
        missing: tuple[str, ...] = ()
        if departure is not None:
            missing = self._arrive(request, departure)
        if fault:
            self._node.get_logger().error(f"rosrm asked this node to leave; it stays: {fault}")
        seconds = listener.status.seconds
        listener.finish(Status(State.RUNNING, request.id, fault, seconds, missing))

    def _arrive(self, request: Request, departure: Departure) -> tuple[str, ...]:
        listener = self._its_listener()
        began = clocks.boot_time()
        listener.enter(State.JOINING, request.id)
        guids_are_new = fast_dds_relocation.look_again()
        entries = self._enter(departure)
        seen = clocks.boot_time()
        node = self._node
        node._portable_join_again(departure)  # noqa: SLF001 - the other half of one thing
        self._add_executor()
        left = max(0.0, began + self._patience - clocks.boot_time())
        missing: tuple[str, ...] = node._portable_go_on(departure, left)  # noqa: SLF001
        found = clocks.boot_time()
        times = {
            "enter": round(seen - began, 6), "entries": entries, "join": round(found - seen, 6),
        }  # fmt: skip
        status = listener.status
        listener.status = replace(status, seconds={**status.seconds, **times})
        if not guids_are_new:
            self._node.get_logger().warning("Fast DDS keeps its GUIDs: restore an image only once")
        if missing:
            self._node.get_logger().warning(
                f"continues without some of its former peers: {', '.join(missing)}"
            )
        return missing

    def _enter(self, departure: Departure) -> int:
        """Enter the graph until the other endpoints are visible; return the number of attempts.

        A neighbour answers a participant's first announcement within 0.1 ms. Fast DDS 2.14 may
        not be ready to receive that answer, and gets the next one only after the neighbour's
        period of 3 s. So the node requests the announcements of all neighbours. If that request
        is lost as well, the node enters as another participant (docs/decisions/0024).
        """
        entries = 0
        deadline = clocks.boot_time() + self._patience
        while True:
            entries += 1
            self._give_signals_back()
            rclpy.init(args=without_parameter_files(self._args))
            self._node._portable_enter_again(departure)  # noqa: SLF001 - the other half of one thing
            last = entries == _ENTRIES or deadline - clocks.boot_time() <= _GREETED
            if last or sees_again(self._node, departure.others, _GREETED):
                self._is_in = True
                return entries
            self._node.destroy_node()
            rclpy.try_shutdown()

    def _its_listener(self) -> Listener:
        assert self._listener is not None  # called only if there is one
        return self._listener


def _unfinished(executor: Any) -> list[Any]:
    """Return the pending tasks of rclpy's executor, which has no public interface for them."""
    return [task for task, *_ in getattr(executor, "_tasks", ()) if not task.done()]


def _not_clean() -> str:
    """Return the obstacle to a dump of this process; "": there is none."""
    if not what_is_left():
        return ""
    gc.collect()  # frees entities in reference cycles
    return what_is_left()


def _end(*_: object) -> None:
    raise _Ended


def without_parameter_files(args: Sequence[str]) -> list[str]:
    """Return a command line without `--params-file FILE`, which may be missing on another host."""
    kept: list[str] = []
    words = iter(args)
    for word in words:
        if word == "--params-file":
            next(words, None)
        else:
            kept.append(word)
    return kept


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
