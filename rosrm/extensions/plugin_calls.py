"""Guarded calls of plugins by the core: a failed call affects one decision and is recorded.

========  ==========================================  =====================================
state     event                                       consequence
========  ==========================================  =====================================
selected  a call raises, is late, or answers in       `failing`; a record
          breach of the contract
failing   a call fails with another error             a record, at most one in
                                                      `RECORD_PERIOD` seconds
failing   each method that failed has succeeded       `selected`; a record
          since, the last failure was `WORKS_AFTER`
          seconds ago
========  ==========================================  =====================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from inspect import getattr_static, unwrap
from math import inf
from types import CodeType, MemberDescriptorType
from typing import Any, Final, NoReturn, TypeGuard, TypeVar, cast

from rosrm.errors import (
    PluginError,
    PluginInterrupt,
    describe_place,
    describe_plugin_fault,
    plain_text,
)
from rosrm.model.rows import PluginKind
from rosrm.wording import counted, duration

T = TypeVar("T")
#: Kind and name of an offer.
Plugin = tuple[PluginKind, str]
#: Exceptions that are answers by contract, such as "this host has no such device".
Answers = tuple[type[Exception], ...]
#: Function that executes a call; raises `TimeoutError` if the call takes too long.
Limit = Callable[[Plugin, Callable[[], Any]], Any]

#: Names of the kinds of offers in messages.
TITLES: Final[Mapping[PluginKind, str]] = {
    "probe": "probe",
    "scoring": "scoring policy",
    "filter": "filter",
    "migration": "migration strategy",
    "checkpoint": "checkpoint policy",
    "launcher": "launcher",
    "sink": "event sink",
}

#: Seconds without a failure after which a valid answer ends the state "failing". Otherwise a plugin
#: that fails for every second process would cause a record with each of them.
WORKS_AFTER: Final = 10.0
#: Seconds between two records of one plugin's errors, because the text may differ in each call.
RECORD_PERIOD: Final = 60.0


@dataclass(slots=True)
class Failing:
    """A plugin that fails.

    Attributes:
        error: last failure: the hook, the exception and its place.
        count: number of failures since the plugin worked last.
        last: time of the last failure.
        hooks: methods that have not succeeded since their last failure.
    """

    error: str = ""
    count: int = 0
    last: float = -inf
    hooks: set[str] = field(default_factory=set)
    _recorded: str = ""
    _recorded_at: float = -inf

    def note(self, error: str, count: int, now: float) -> bool:
        """Note the newest error; return True if it must be recorded."""
        self.error, self.count, self.last = error, self.count + count, now
        if error == self._recorded or now - self._recorded_at < RECORD_PERIOD:
            return False
        self._recorded, self._recorded_at = error, now
        return True

    def reason(self, now: float) -> str:
        """Return the last error, its age and the number of failures, for a listing."""
        since = "" if self.hooks else "; it has succeeded since"
        age = duration(now - self.last)
        return f"{self.error}; {counted(self.count, 'failure')} so far, the last {age} ago{since}"


#: Plugin that is being called in this thread. A slave asks plugins in several threads, and the
#: call of one thread does not cover that of another one.
_running: Final[ContextVar[Plugin | None]] = ContextVar("_running", default=None)


def _without_limit(_plugin: Plugin, call: Callable[[], Any]) -> Any:
    return call()


@dataclass(slots=True)
class PluginCalls:
    """The guard of all plugin calls of a master.

    Attributes:
        limit: executes each call; the master sets a function with a time-out.
        failing: the failing plugins.
    """

    limit: Limit = _without_limit
    failing: dict[Plugin, Failing] = field(default_factory=dict)
    _failed: dict[Plugin, Failing] = field(default_factory=dict)
    _worked: set[tuple[Plugin, str]] = field(default_factory=set)

    def ask(
        self, kind: PluginKind, name: str, hook: str, call: Callable[[], T], of: object = None,
        lets: Answers = (),
    ) -> T:  # fmt: skip
        """Return the answer of a plugin.

        A call within a call of the same plugin has no time-out of its own, because that of the
        outer one covers it.

        Args:
            kind: kind of the offer.
            name: name of the offer.
            hook: name of the called method, for messages.
            call: calls the method and checks the answer; raises `PluginError` for an invalid one.
            of: object with the method; its place is added to the text about an invalid answer.
            lets: as in `contained`.

        Raises:
            PluginError: the call failed; the text has the error and its place.
        """
        plugin, outer = (kind, name), _running.get()
        placed = partial(contained, call, of=of, hook=hook, lets=lets)
        _running.set(plugin)
        try:
            answer: T = placed() if plugin == outer else self.limit(plugin, placed)
        except KeyboardInterrupt:  # the user's Ctrl-C in a command or simulation
            raise
        except BaseException as fault:  # a late call; `contained` has converted any other
            if answer_of(fault, lets) is not None:
                raise
            reason = describe_plugin_fault(fault)
            self.note(plugin, hook, f"{hook}: {reason}")
            raise PluginError(reason) from fault
        finally:
            _running.set(outer)
        self.note(plugin, hook)
        return answer

    def note(self, plugin: Plugin, hook: str, error: str = "") -> None:
        """Note the error of a call; "": it succeeded. May be called from any thread.

        Args:
            hook: the called method; "": it is not known, and the success of any other replaces it.
        """
        if error:
            noted = self._failed.setdefault(plugin, Failing())
            noted.error, noted.count = error, noted.count + 1
            noted.hooks.add(hook)
        elif plugin in self.failing:
            self._worked.add((plugin, hook))

    def changes(self, now: float) -> list[tuple[Plugin, str]]:
        """Return the plugins that began to fail, or to work (""), since the last call."""
        if not self._failed and not self.failing:
            return []
        found: list[tuple[Plugin, str]] = []
        failed, self._failed = self._failed, {}
        worked, self._worked = self._worked, set()
        for plugin, hook in list(worked):  # a thread may still note a success
            if known := self.failing.get(plugin):  # a thread may note this after the end
                known.hooks -= {hook, ""}
        for plugin, noted in list(failed.items()):  # a thread may still note an error
            known = self.failing.setdefault(plugin, Failing())
            known.hooks |= noted.hooks
            if known.note(noted.error, noted.count, now):
                found.append((plugin, noted.error))
        for plugin, known in sorted(self.failing.items()):
            if not known.hooks and now - known.last >= WORKS_AFTER:
                del self.failing[plugin]
                found.append((plugin, ""))
        return found


def titled(kind: PluginKind, name: str) -> str:
    """Return kind and name of a plugin, for messages and notes."""
    return f"{TITLES[kind]} {name!r}"


def contained(call: Callable[[], T], *, of: object = None, hook: str = "", lets: Answers = ()) -> T:
    """Return the answer of plugin code; whatever the code raises becomes a `PluginError`.

    `rosrm.extensions.guard` adds what the core may not do: a time-out and the state of the process.

    Args:
        call: calls the plugin and checks the answer; raises `PluginError` for an invalid one.
        of: object with the called method; its place is added to the text about an invalid answer.
        hook: name of that method.
        lets: exceptions that are answers by contract. They are raised again as the first class
            that fits, with a printable text of bounded length.

    Raises:
        PluginError: the text has the error and its place, and is printable and bounded, too.
        KeyboardInterrupt: the user's, or the plugin's, which the guard tells apart.
    """
    try:
        return call()
    except KeyboardInterrupt:
        raise
    except BaseException as fault:  # noqa: BLE001 - see above
        error = _converted(fault, of, hook, lets)
    return raise_alone(error)


def raise_alone(error: BaseException) -> NoReturn:
    """Raise an error, outside of any `except` clause, without a cycle through its traceback.

    The exception of a plugin is dropped before. Otherwise the objects in the plugin's frames would
    end after the guard, and the end of a connection may block.
    """
    try:
        raise error
    finally:
        del error


def raised(fault: BaseException) -> PluginError:
    """Return a `PluginError` about an exception of a plugin."""
    error = PluginError(describe_plugin_fault(fault))
    error.was_raised = True
    return error


def _converted(
    fault: BaseException, of: object, hook: str, lets: Answers
) -> PluginError | Exception:
    # By its exact type, because a plugin may raise an error of its own with any methods.
    if type(fault) is PluginError:
        said = PluginError(plain_text(_said(fault), lines=True))
        return PluginError(with_place(said, of, hook))
    if type(fault) is PluginInterrupt:
        fault.place = describe_place(fault)
        BaseException.with_traceback(fault, None).__context__ = None
    answer = answer_of(fault, lets)
    return raised(fault) if answer is None else answer(plain_text(_said(fault), lines=True))


def answer_of(fault: BaseException, lets: Answers) -> type[Exception] | None:
    """Return the class of answers by contract to which an exception belongs; None: it is a fault.

    Unlike `isinstance`, this does not read `__class__`, which may be a property of the plugin.
    """
    return next((one for one in lets if issubclass(type(fault), one)), None)


def _said(fault: BaseException) -> str:
    try:
        return str(fault)
    except BaseException:  # noqa: BLE001 - a plugin's exception may fail to give its text
        return describe_plugin_fault(fault)


def implements(plugin: object, contract: Callable[..., T]) -> TypeGuard[T]:
    """Return True if a plugin has every member of a protocol, without running plugin code.

    `isinstance` would evaluate the plugin's properties, because it calls `hasattr` before Python
    3.12.
    """
    return all(
        name.startswith("_") or getattr_static(plugin, name, None) is not None
        for name in vars(contract)
    )


def required(answer: object, kind: type[T]) -> T:
    """Return an answer of the required type; raise `PluginError` for any other.

    A text is returned as a printable `str` of bounded length; newlines stay.
    """
    if not issubclass(type(answer), kind):  # `isinstance` would trust its `__class__`
        raise PluginError(f"answered {given(answer)}; {kind.__name__} is required")
    return cast(T, plain_text(answer, lines=True) if kind is str else answer)


def with_place(fault: PluginError, owner: object, method: str) -> str:
    """Return the text about an invalid answer, with the place of the plugin's method."""
    try:
        place = _place_of(owner, method)
    except BaseException:  # noqa: BLE001 - the method may be an object with any attributes
        place = ""
    return f"{fault} ({place})" if place else str(fault)


def _place_of(owner: object, name: str) -> str:
    """Return file and line of the definition of a method or property; "": rosrm's, or unknown.

    No file is read, and no code of the plugin runs but that of a method that is no function.
    """
    found = getattr_static(owner, name, None)
    if isinstance(found, MemberDescriptorType):
        found = found.__get__(owner)
    if isinstance(found, property):
        found = found.fget
    if isinstance(found, staticmethod | classmethod):
        found = found.__func__
    function: Any = unwrap(found) if callable(found) else found
    code = getattr(function, "__code__", None)
    if not isinstance(code, CodeType) or str(function.__module__).partition(".")[0] == "rosrm":
        return ""
    return f"{code.co_filename}:{code.co_firstlineno}"


def given(answer: object) -> str:
    """Return the type of a wrong answer, for messages."""
    return "None" if answer is None else f"a {plain_text(type(answer).__name__)[:100]}"
