"""Executors: functions of plugins that run on this host in the open step of a plan."""

from __future__ import annotations

import json
import logging
import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from rosrm import clocks, threads
from rosrm.errors import PluginError, Refused, RosrmError, describe_fault
from rosrm.extensions.contracts import Executor
from rosrm.extensions.discovery import definition
from rosrm.extensions.guard import guarded
from rosrm.extensions.made import OfferedExecutor
from rosrm.extensions.plugin_calls import WORKS_AFTER, Plugin, given, titled
from rosrm.ros.slave.services import ExecutorOutcome

_log = logging.getLogger("rosrm.slave")

#: Marks an error that is too recent to forget, although a later call has succeeded.
_SINCE: Final = "; it has succeeded since"
#: Maximum number of calls of one executor that have not returned in time; each keeps a thread.
MOST_LATE: Final = 8
#: Maximum number of characters of a result, as the master accepts it.
MOST_LETTERS_OF_RESULT: Final = 1 << 20
#: Takes the outcome of an executor.
Done = Callable[[ExecutorOutcome], None]


class Executors:
    """Executors of a host, and the migration strategies that fail because of them.

    Args:
        offered: executors by name.
        broken: strategies whose offers are broken on this host, with the reasons.
        post: schedules a call in the loop.
        changed: called in the loop with a message when `failing` has changed.
        clock: monotonic seconds.

    Attributes:
        failing: last error by strategy. A strategy whose offer is broken stays. Any other is
            removed by a valid answer at least `WORKS_AFTER` seconds after its last failure.
    """

    def __init__(
        self, offered: Mapping[str, OfferedExecutor], broken: Mapping[str, str], *,
        post: Callable[[Callable[[], None]], None], changed: Callable[[str], None],
        clock: Callable[[], float] = clocks.boot_time,
    ) -> None:  # fmt: skip
        self._offered = offered
        self._post = post
        self._changed = changed
        self._clock = clock
        self._failed_at: dict[str, float] = {}
        self._late: Counter[str] = Counter()
        self._open: dict[tuple[str, str], list[Done]] = {}
        self.failing = dict(broken)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all executors."""
        return tuple(self._offered)

    def failing_plugins(self) -> dict[Plugin, str]:
        """Return the errors of failing plugins by kind and name."""
        return {("migration", strategy): error for strategy, error in self.failing.items()}

    def execute(
        self, name: str, arguments: Mapping[str, Any], timeout: float, *, here: Mapping[str, Any],
        done: Done,
    ) -> None:  # fmt: skip
        """Run an executor in a thread of its own.

        A call with the same arguments that has not returned answers the order, too: a restarted
        master repeats the order of its step, and two calls at once would disturb each other.

        Args:
            arguments: a JSON object.
            timeout: seconds, after which its strategy counts as failing.
            here: description of this host in JSON types, a further argument; the strategy's
                options for this host are added.
            done: called in the loop with the outcome.

        Raises:
            Refused: there is no executor of this name, or `MOST_LATE` calls of it hang.
        """
        offered = self._offered.get(name)
        if offered is None:
            there = ", ".join(sorted(self._offered)) or "none"
            raise Refused(f"no executor {name!r} on {here['host']}; there are: {there}")
        if self._late[name] >= MOST_LATE:
            raise Refused(
                f"executor {name} on {here['host']}: {MOST_LATE} earlier calls of it have not "
                "returned; restart the slave after the cause has been corrected"
            )
        call = name, json.dumps(dict(arguments), sort_keys=True, default=dict)
        if call in self._open:
            self._open[call].append(done)
            return
        self._open[call] = [done]
        complete = {**arguments, "here": {**here, "options": dict(offered.options)}}
        try:
            self._begin(offered, call, complete, timeout)
        except RuntimeError as fault:  # no further thread
            del self._open[call]
            raise Refused(f"executor {name} on {here['host']}: {fault}") from None

    def _begin(
        self, offered: OfferedExecutor, call: tuple[str, str], arguments: Mapping[str, Any],
        timeout: float,
    ) -> None:  # fmt: skip
        """Start the thread of a call; raises RuntimeError."""
        strategy, function, (name, _) = offered.strategy, offered.call, call
        place, waiting = definition(function), self._open[call]
        is_late: bool | None = False  # None: it has returned

        def note_late() -> None:
            nonlocal is_late
            if is_late is not None:
                is_late = True
                self._late[name] += 1
                del self._open[call]
                self._fail(
                    strategy, f"executor {name} did not return within {timeout:g} s ({place})"
                )

        timer = threading.Timer(min(timeout, threading.TIMEOUT_MAX), self._post, [note_late])
        timer.daemon = True

        def settle(outcome: ExecutorOutcome) -> None:
            nonlocal is_late
            self._late[name] -= bool(is_late)
            if not is_late:
                del self._open[call]
            is_late = None
            if outcome.code in ("", "unable"):
                self._work(strategy)
            else:
                where = f" ({place})" if outcome.code == "bad_result" else ""
                self._fail(strategy, f"executor {outcome.message}{where}")
            for one in waiting:
                one(outcome)

        def work() -> None:
            outcome = _outcome(titled("migration", strategy), name, function, arguments)
            timer.cancel()
            self._post(partial(settle, outcome))

        def fail(fault: BaseException) -> None:
            timer.cancel()
            outcome = ExecutorOutcome("failed", f"{name}: {describe_fault(fault)}")
            self._post(partial(settle, outcome))

        try:
            if timeout > 0.0:
                timer.start()
            threads.start(work, f"executor {name}", failed=fail)
        except RuntimeError:
            timer.cancel()
            raise

    def _fail(self, strategy: str, error: str) -> None:
        self._failed_at[strategy] = self._clock()
        if self.failing.get(strategy) != error:
            self.failing[strategy] = error
            self._changed(f"migration strategy {strategy} fails: {error}")

    def _work(self, strategy: str) -> None:
        failed_at = self._failed_at.get(strategy)
        if failed_at is None:
            return
        if self._clock() - failed_at >= WORKS_AFTER:
            del self.failing[strategy], self._failed_at[strategy]
            self._changed(f"migration strategy {strategy} works again")
        elif not self.failing[strategy].endswith(_SINCE):
            self.failing[strategy] += _SINCE
            self._changed(f"migration strategy {strategy} has succeeded since its last failure")


def _outcome(
    whom: str, name: str, function: Executor, arguments: Mapping[str, Any]
) -> ExecutorOutcome:
    """Run an executor; return its outcome."""

    def run() -> ExecutorOutcome:
        result: object = function(arguments)
        if not isinstance(result, Mapping):
            wrong = f"{name} answered {given(result)}; a JSON object is required"
            return ExecutorOutcome("bad_result", wrong)
        strange = _no_json(result, "")
        if strange:
            wrong = f"{name} answered something that is no JSON: {strange}"
            return ExecutorOutcome("bad_result", wrong)
        text = json.dumps(result, default=dict)
        if len(text) > MOST_LETTERS_OF_RESULT:
            wrong = f"{name} answered {len(text)} bytes; allowed: {MOST_LETTERS_OF_RESULT}"
            return ExecutorOutcome("bad_result", wrong)
        return ExecutorOutcome("", result=text)

    try:
        return guarded(run, whom=whom, hook=f"executor {name}", lets=(RosrmError, ValueError))
    except RosrmError as error:
        if isinstance(error, PluginError):
            return ExecutorOutcome("failed", f"{name} raised {error}")
        return ExecutorOutcome("unable", str(error))
    except ValueError as error:
        return ExecutorOutcome("unable", f"{name}: {error}")


def _no_json(value: object, path: str) -> str:
    """Return path and type of the first value that JSON cannot hold; "" if there is none."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not _is_plain(key):
                return f"the key {key!r}: {type(key).__name__}"
            if strange := _no_json(item, f"{path}.{key}" if path else key):
                return strange
        return ""
    if isinstance(value, list | tuple):
        found = (_no_json(item, f"{path}[{index}]") for index, item in enumerate(value))
        return next(filter(None, found), "")
    if isinstance(value, float) and not math.isfinite(value):
        return f"{path}: {value}"
    return "" if _is_plain(value) else f"{path}: {type(value).__name__}"


def _is_plain(value: object) -> bool:
    return value is None or isinstance(value, (str, int, float))
