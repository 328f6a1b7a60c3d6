"""Guarded calls of plugins by the core: a failed call costs one decision, and is counted.

============  ============================================================================
plugin state  recorded event, and the next state
============  ============================================================================
selected      a call raises, is late, or breaks the contract by its answer: `failing`
failing       a call fails with an error other than the last recorded one: at most one record in
              `RECORD_PERIOD` seconds
failing       a call is good, and no call has failed for `WORKS_AFTER` seconds: `selected`
============  ============================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from inspect import getattr_static
from math import inf
from typing import Any, Final, TypeGuard, TypeVar

from rosrm.errors import PluginError, describe_plugin_fault
from rosrm.model.rows import PluginKind
from rosrm.wording import counted

T = TypeVar("T")
#: Kind and name of an offer.
Plugin = tuple[PluginKind, str]
#: Carries a call out; may raise `TimeoutError` when the call takes too long.
Limit = Callable[[Plugin, Callable[[], Any]], Any]

#: Names of the kinds of offers in messages.
TITLES: Final[Mapping[PluginKind, str]] = {
    "probe": "probe",
    "scoring": "scoring policy",
    "migration": "migration strategy",
    "checkpoint": "checkpoint policy",
    "launcher": "launcher",
}

#: Seconds without a failure after which a good answer ends the state "failing". Otherwise a plugin
#: that fails for every second process would be recorded with each of them.
WORKS_AFTER: Final = 10.0
#: Seconds between two records of one plugin's errors. An error may name what differs in each call.
RECORD_PERIOD: Final = 60.0


@dataclass(slots=True)
class Failing:
    """A plugin that fails.

    Attributes:
        error: of the last failure: the hook, the exception and its place.
        count: failures since the plugin worked last.
        last: time of the last failure.
    """

    error: str = ""
    count: int = 0
    last: float = -inf
    _recorded: str = ""
    _recorded_at: float = -inf

    def note(self, error: str, count: int, now: float) -> bool:
        """Note the newest error; return True if it is to be recorded."""
        self.error, self.count, self.last = error, self.count + count, now
        if error == self._recorded or now - self._recorded_at < RECORD_PERIOD:
            return False
        self._recorded, self._recorded_at = error, now
        return True

    @property
    def reason(self) -> str:
        """Return the last error and the number of failures, for a listing."""
        return f"{self.error}; {counted(self.count, 'failure')} so far"


def _without_limit(_plugin: Plugin, call: Callable[[], Any]) -> Any:
    return call()


@dataclass(slots=True)
class PluginCalls:
    """The one guard around the plugins of a master.

    Attributes:
        limit: carries each call out; the master sets one with a deadline.
        failing: the plugins that fail.
    """

    limit: Limit = _without_limit
    failing: dict[Plugin, Failing] = field(default_factory=dict)
    _failed: dict[Plugin, Failing] = field(default_factory=dict)
    _worked: set[Plugin] = field(default_factory=set)

    def ask(self, kind: PluginKind, name: str, hook: str, call: Callable[[], T]) -> T:
        """Return the answer of a plugin.

        Args:
            kind: of the offer.
            name: of the offer.
            hook: that is called, for messages.
            call: calls the hook and checks the answer; raises `PluginError` for a bad answer.

        Raises:
            PluginError: the call failed; the text has the error and its place.
        """
        plugin = (kind, name)
        try:
            answer: T = self.limit(plugin, call)
        except KeyboardInterrupt:  # Ctrl-C of a simulation; a master turns it into a flag
            raise
        except BaseException as fault:  # whatever a plugin raises, even SystemExit
            reason = describe_plugin_fault(fault)
            noted = self._failed.setdefault(plugin, Failing())
            noted.error, noted.count = f"{hook}: {reason}", noted.count + 1
            raise PluginError(reason) from fault
        if plugin in self.failing:
            self._worked.add(plugin)
        return answer

    def changes(self, now: float) -> list[tuple[Plugin, str]]:
        """Return the plugins that fail, or work again (""), since the last call."""
        found: list[tuple[Plugin, str]] = []
        for plugin, noted in self._failed.items():
            if self.failing.setdefault(plugin, Failing()).note(noted.error, noted.count, now):
                found.append((plugin, noted.error))
        for plugin in sorted(self._worked - self._failed.keys()):
            if now - self.failing[plugin].last >= WORKS_AFTER:
                del self.failing[plugin]
                found.append((plugin, ""))
        self._failed.clear()
        self._worked.clear()
        return found


def implements(plugin: object, contract: Callable[..., T]) -> TypeGuard[T]:
    """Return True if a plugin has every member of a protocol; no code of the plugin runs.

    `isinstance` evaluates the properties of the plugin, because Python before 3.12 asks `hasattr`.
    """
    return all(
        name.startswith("_") or getattr_static(plugin, name, None) is not None
        for name in vars(contract)
    )


def required(answer: object, kind: type[T]) -> T:
    """Return an answer of the required type; raise `PluginError` for any other."""
    if not isinstance(answer, kind):
        raise PluginError(f"answered {given(answer)}; {kind.__name__} is required")
    return answer


def given(answer: object) -> str:
    """Return the type of a wrong answer, for messages."""
    return "None" if answer is None else f"a {type(answer).__name__}"
