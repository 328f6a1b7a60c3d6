"""Keys of `alerts.yaml`: conditions, and the steps of tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, Protocol

from rosrm.config.checking import near
from rosrm.config.process import ListOfWords
from rosrm.extensions.units import Fraction, PositiveCount, ResourceName, Seconds
from rosrm.model.event_kinds import EventKind
from rosrm.model.notices import NoticeLevel
from rosrm.model.rows import PROCESS_STATES
from rosrm.model.values import EMPTY
from rosrm_alerts.conditions import (
    ANY,
    Above,
    Condition,
    Happens,
    HostLost,
    InState,
    NoAnswer,
    SeenEvent,
    SeenProcess,
)
from rosrm_alerts.rehearsal import Expected, Rehearsal, RehearsedHost, Step

#: Words for kinds of events.
EVENT_KINDS: Final = tuple(kind.value for kind in EventKind)


@dataclass(frozen=True, slots=True)
class Forwarded:
    """Events that go to sinks as they happen.

    Attributes:
        to: names of sinks.
        kinds: kinds of the events; (): all.
    """

    to: ListOfWords
    kinds: ListOfWords = ()


@dataclass(frozen=True, slots=True)
class AlertInFile:
    """Keys of an alert, except `when`."""

    to: ListOfWords = ()
    level: NoticeLevel = "WARN"


@dataclass(frozen=True)
class OneOf:
    """Annotation of text that is one of some words."""

    allowed: tuple[str, ...]

    def check(self, word: str) -> str:
        """Return the word; raise `ValueError` with the nearest one if it is not allowed."""
        if word not in self.allowed:
            raise ValueError(f"{word!r} is unknown{near(word, self.allowed)}")
        return word

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return a schema with which pydantic calls `check`."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_after_validator_function(self.check, handler(source))


#: Kind of an event, and state of a process.
EventWord = Annotated[str, OneOf(EVENT_KINDS)]
ProcessState = Annotated[str, OneOf(PROCESS_STATES)]


@dataclass(frozen=True, slots=True)
class HostInFile:
    """A host in a step of a test."""

    state: Literal["up", "suspect", "lost", "left"] | None = None
    usage: Mapping[ResourceName, Fraction] = field(default_factory=lambda: EMPTY)
    limits: Mapping[ResourceName, Fraction] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True)
class ProcessInFile:
    """A process in a step of a test."""

    state: ProcessState
    application: str = ""


@dataclass(frozen=True, slots=True)
class EventInFile:
    """An event in a step of a test."""

    kind: EventWord
    process: str = ""
    host: str = ""


@dataclass(frozen=True, slots=True)
class StepInFile:
    """A step of a test."""

    at: Seconds
    hosts: Mapping[str, HostInFile] = field(default_factory=lambda: EMPTY)
    processes: Mapping[str, ProcessInFile] = field(default_factory=lambda: EMPTY)
    events: tuple[EventInFile, ...] = ()
    master: bool | None = None

    def step(self) -> Step:
        """Return the step."""
        return Step(
            self.at,
            {
                name: RehearsedHost(host.state, host.usage, host.limits)
                for name, host in self.hosts.items()
            },
            {name: SeenProcess(one.state, one.application) for name, one in self.processes.items()},
            tuple(SeenEvent(one.kind, one.process, one.host) for one in self.events),
            self.master,
        )


@dataclass(frozen=True, slots=True)
class ExpectedInFile:
    """A change of an alert that a test expects."""

    at: Seconds
    begins: str = ""
    ends: str = ""
    about: str = ""

    def __post_init__(self) -> None:
        """Refuse two changes in one; raises `ValueError`."""
        if bool(self.begins) == bool(self.ends):
            raise ValueError("the name of one alert is required: `begins: NAME` or `ends: NAME`")

    def expected(self) -> Expected:
        """Return the expected change."""
        return Expected(
            self.at, self.begins or self.ends, "begins" if self.begins else "ends", self.about
        )


@dataclass(frozen=True, slots=True)
class TestInFile:
    """A test of the alerts."""

    name: str
    steps: tuple[StepInFile, ...]
    expect: tuple[ExpectedInFile, ...] = ()
    until: Seconds = 0.0

    def rehearsal(self) -> Rehearsal:
        """Return the test."""
        return Rehearsal(
            self.name,
            tuple(one.step() for one in self.steps),
            tuple(one.expected() for one in self.expect),
            self.until,
        )


class ConditionInFile(Protocol):
    """`when` of an alert."""

    def condition(self) -> Condition:
        """Return the condition; raise `ValueError` for values that do not go together."""


@dataclass(frozen=True, slots=True)
class HappensInFile:
    """`when` of an alert on events."""

    event: ListOfWords
    process: str = ANY
    host: str = ANY
    application: str = ANY
    count: PositiveCount = 1
    within: Seconds = 0.0

    def condition(self) -> Condition:
        """Return the condition."""
        _check_words("event", self.event, OneOf(EVENT_KINDS))
        if (self.count > 1) != (self.within > 0.0):
            raise ValueError("`count` and `within` go together, such as `count: 3, within: 10min`")
        return Happens(
            frozenset(self.event), self.process, self.host, self.application, self.count,
            self.within,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class HostLostInFile:
    """`when` of an alert on lost hosts."""

    host_lost: str

    def condition(self) -> Condition:
        """Return the condition."""
        return HostLost(self.host_lost)


@dataclass(frozen=True, slots=True)
class OverLimitInFile:
    """`when` of an alert on hosts over their own limit."""

    over_limit: ResourceName
    host: str = ANY

    def condition(self) -> Condition:
        """Return the condition."""
        return Above(self.over_limit, None, self.host)


@dataclass(frozen=True, slots=True)
class AboveInFile:
    """`when` of an alert on hosts above a limit of this file."""

    above: Mapping[ResourceName, Fraction]
    host: str = ANY

    def condition(self) -> Condition:
        """Return the condition."""
        if len(self.above) != 1:
            raise ValueError("above: one resource is required, such as `above: {memory: 0.9}`")
        ((resource, limit),) = self.above.items()
        return Above(resource, limit, self.host)


@dataclass(frozen=True, slots=True)
class StateInFile:
    """`when` of an alert on processes in some states."""

    state: ListOfWords
    process: str = ANY
    application: str = ANY

    def condition(self) -> Condition:
        """Return the condition."""
        _check_words("state", self.state, OneOf(PROCESS_STATES))
        return InState(frozenset(self.state), self.process, self.application)


@dataclass(frozen=True, slots=True)
class NoMasterInFile:
    """`when` of an alert on a master that does not answer."""

    no_master: bool

    def condition(self) -> Condition:
        """Return the condition."""
        if not self.no_master:
            raise ValueError("no_master: the only value is `true`")
        return NoAnswer()


#: The key that tells each condition, with the type of its keys.
CONDITIONS: Final[Mapping[str, type[ConditionInFile]]] = {
    "event": HappensInFile,
    "host_lost": HostLostInFile,
    "over_limit": OverLimitInFile,
    "above": AboveInFile,
    "state": StateInFile,
    "no_master": NoMasterInFile,
}


def _check_words(key: str, given: tuple[str, ...], allowed: OneOf) -> None:
    """Check words in a list that may be one word, which pydantic cannot annotate."""
    if not given:
        raise ValueError(f"{key}: give at least one")
    for word in given:
        allowed.check(word)
