"""Objects that the offers of plugins created, and their checks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from operator import methodcaller
from typing import Any, Final

from rosrm.errors import PluginError
from rosrm.extensions.answers import exact, exact_fields
from rosrm.extensions.contracts import Executor, Launcher, Probe, ProbeOffer
from rosrm.extensions.guard import guarded
from rosrm.model.description_checks import resource_fault
from rosrm.model.devices import Device
from rosrm.model.rows import PluginKind
from rosrm.model.values import (
    EMPTY,
    MOST_USED,
    RESOURCE_SLOTS,
    Reading,
    ResourceDescription,
)
from rosrm.wording import get_close_matches

#: Members that an object of each kind must have.
_METHODS: Final[Mapping[PluginKind, tuple[str, ...]]] = {
    "probe": ("resources", "read", "close"),
    "scoring": ("score",),
    "filter": ("mask", "reason"),
    "migration": ("propose",),
    "checkpoint": ("choose",),
    "launcher": ("prepare",),
    "sink": ("send", "close"),
}

#: Most labels from all probes of a host; a registration with more than 256 would be refused.
_MOST_LABELS: Final = 128
_LONGEST_LABEL: Final = 200
#: Seconds between two reads of a `FailedProbe`.
_FAILED_PERIOD: Final = 10.0


@dataclass(frozen=True)
class MadeProbe:
    """A probe on this host; period and deadline, in seconds, are those of its offer.

    Attributes:
        labels: labels that the probe gives to the host.
    """

    name: str
    probe: Probe
    resources: tuple[ResourceDescription, ...]
    period: float
    deadline: float
    labels: Mapping[str, str] = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True)
class DraftedProbe:
    """A created probe with its own description, before the comparison with the other probes.

    Attributes:
        measures: it measures how much single processes use.
    """

    offer: ProbeOffer
    probe: Probe
    resources: tuple[ResourceDescription, ...]
    labels: Mapping[str, str]
    measures: bool


@dataclass(frozen=True)
class Probes:
    """The probes of a host.

    Attributes:
        made: created probes, and a `FailedProbe` for each probe that could not be created.
        absent: name of each probe that is absent on this host to the reason (`SkipPlugin`).
    """

    made: tuple[MadeProbe, ...]
    absent: Mapping[str, str]

    @property
    def labels(self) -> dict[str, str]:
        """Return the labels of the host from all its probes."""
        return {key: value for one in self.made for key, value in one.labels.items()}


class ProbeList:
    """The probes of a host while they are created, in any order.

    Args:
        offers: of the wanted probes, by name.
        awaited: returns why a probe that is not created yet cannot be read.
    """

    def __init__(self, offers: Mapping[str, ProbeOffer], awaited: Callable[[str], str]) -> None:
        self._offers, self._awaited = offers, awaited
        self._made: list[MadeProbe] = []
        self._absent: dict[str, str] = {}
        self._failed = dict.fromkeys(offers, "")  # "": not created yet

    def fault_of(self, drafted: DraftedProbe) -> str:
        """Return why the host cannot have a probe beside those that were added, as a predicate.

        "": it can.
        """
        return (
            fault_of_resources(drafted.resources, drafted.offer, self._made)
            or unmeasured(drafted.resources, measures=drafted.measures)
            or fault_of_labels(drafted.labels, self._made)
        )

    def add(self, drafted: DraftedProbe) -> None:
        """Add a probe without a fault."""
        offer = drafted.offer
        del self._failed[offer.name]
        self._made.append(
            MadeProbe(
                offer.name, drafted.probe, drafted.resources, offer.period, offer.deadline,
                dict(drafted.labels),
            )
        )  # fmt: skip

    def leave_out(self, name: str, reason: str) -> None:
        """Note that a probe is absent on this host."""
        del self._failed[name]
        self._absent[name] = reason

    def fail(self, name: str, reason: str) -> None:
        """Note why a probe could not be created."""
        self._failed[name] = reason

    @property
    def probes(self) -> Probes:
        """Return the added probes, and a `FailedProbe` for each other one that is not absent."""
        made = list(self._made)
        for name, reason in self._failed.items():
            made.append(failed_probe(self._offers[name], reason or self._awaited(name), made))
        return Probes(tuple(made), dict(self._absent))


class FailedProbe:
    """Substitute for a chosen probe that is not, or not yet, created; each read fails.

    So its resources are stale, and the host gets no new work if one of them has a limit, as after a
    failed read of a probe.

    Attributes:
        resources: resources that the offer declares and no other probe reads, of unknown capacity.
        reason: why there is no probe, with the plugin and the place.
    """

    def __init__(self, resources: Sequence[ResourceDescription], reason: str) -> None:
        self.resources = resources
        self.reason = reason

    def read(self) -> Iterable[Reading]:
        """Raise `PluginError` with the reason."""
        raise PluginError(self.reason)

    def devices(self) -> Iterable[Device]:
        """Raise as `read` does, because the probe may find devices."""
        raise PluginError(self.reason)

    def close(self) -> None:
        """Do nothing."""


@dataclass(frozen=True)
class MadeLauncher:
    """A launcher of this host, and the environment variables that it sets."""

    launcher: Launcher
    variables: tuple[str, ...]


@dataclass(frozen=True)
class MadeLaunchers:
    """The launchers of a host.

    Attributes:
        made: name to the created launcher.
        absent: name of each launcher that is absent on this host to the reason (`SkipPlugin`).
        broken: name of each launcher that could not be created to the reason.
    """

    made: Mapping[str, MadeLauncher]
    absent: Mapping[str, str]
    broken: Mapping[str, str]


@dataclass(frozen=True)
class OfferedExecutor:
    """An executor, and the name of the migration strategy that offers it.

    Attributes:
        options: options of this host for the strategy, as JSON types; empty if its file has none.
    """

    strategy: str
    call: Executor
    options: Mapping[str, Any] = field(default_factory=lambda: EMPTY)


# --- checks -----------------------------------------------------------------------------------


def failed_probe(offer: ProbeOffer, reason: str, others: Sequence[MadeProbe]) -> MadeProbe:
    """Return a substitute for a probe that could not be created."""
    taken = {resource.name for other in others for resource in other.resources}
    described = [
        ResourceDescription(resource, "1", 1.0, "unknown")
        for resource in dict.fromkeys(offer.resources)
        if resource not in taken
    ]
    valid = [one for one in described if not resource_fault(one)]
    probe = FailedProbe(tuple(valid[: RESOURCE_SLOTS - len(taken)]), reason)
    return MadeProbe(offer.name, probe, tuple(probe.resources), _FAILED_PERIOD, 1.0)


def missing_method(kind: PluginKind, thing: object) -> str:
    """Return the fault of an object that an offer created; "": it has all its methods."""
    if thing is None:
        wanted = " and ".join(f"`{name}`" for name in _METHODS[kind])
        return f"None; an object with {wanted} is required (does it lack a `return`?)"
    for name in _METHODS[kind]:
        if not hasattr(type(thing), name) and not hasattr(thing, name):
            has = [one for one in dir(thing) if not one.startswith("_")]
            near = get_close_matches(name, has, 1)
            misspelt = f"; is its `{near[0]}` misspelt?" if near else ""
            return f"a {type(thing).__name__}, which has no `{name}`{misspelt}"
    return ""


def taken_resources(described: Iterable[Any]) -> tuple[Any, ...]:
    """Return copies of the resources that a probe describes; what is none of them stays."""
    return tuple(
        exact_fields(one, ResourceDescription) if isinstance(one, ResourceDescription) else one
        for one in islice(described, RESOURCE_SLOTS + 1)
    )


def taken_labels(given: Any) -> Any:
    """Return a copy of the labels of a probe; what is no mapping stays."""
    if not isinstance(given, Mapping):
        return given
    some = islice(given.items(), _MOST_LABELS + 1)
    return {exact(key): exact(value) for key, value in some}


def fault_of_resources(
    resources: Sequence[ResourceDescription], offer: ProbeOffer, before: Sequence[MadeProbe]
) -> str:
    """Return why a host cannot have these resources, as a predicate; "" if it can."""
    taken = {resource.name: other.name for other in before for resource in other.resources}
    if not resources:
        return "describes no resource; raise SkipPlugin in `create` where there is nothing to read"
    for resource in resources:
        fault = resource_fault(resource)
        if fault:
            return fault
        if resource.name in taken:
            return f"reads {resource.name!r}, as {taken[resource.name]!r} does already"
        if resource.name not in offer.resources:
            declared = repr((*offer.resources, resource.name))
            return (
                f"reads {resource.name!r}, which its offer does not declare: "
                f"write ProbeOffer(..., resources={declared})"
            )
    if len(taken) + len(resources) > RESOURCE_SLOTS:
        return f"exceeds the {RESOURCE_SLOTS} resources that a host may have"
    return ""


def fault_of_labels(labels: object, before: Sequence[MadeProbe]) -> str:
    """Return why a host cannot have these labels of a probe, as a predicate; "": it can."""
    if not isinstance(labels, Mapping):
        return f'has the labels {labels!r:.100}; a mapping is required, as {{"key": "value"}}'
    for key, value in labels.items():
        if not (key and _is_text(key) and _is_text(value)):
            return (
                f"has the label {key!r:.100}: {value!r:.100}; printable text of at most "
                f"{_LONGEST_LABEL} characters is required"
            )
        others = [one.name for one in before if one.labels.get(key, value) != value]
        if others:
            return f"gives the label {key!r} another value than {others[0]!r}"
    if len(labels) + sum(len(one.labels) for one in before) > _MOST_LABELS:
        return f"exceeds the {_MOST_LABELS} labels that the probes of a host may give"
    return ""


def _is_text(word: object) -> bool:
    return isinstance(word, str) and word.isprintable() and len(word) <= _LONGEST_LABEL


def unmeasured(resources: Sequence[ResourceDescription], *, measures: bool) -> str:
    """Return the fault of a probe that does not measure an attributed resource; "" for none."""
    if measures:
        return ""
    attributed = [
        one.name
        for one in resources
        if one.accounting == "attributed" and one.name not in MOST_USED
    ]
    if not attributed:
        return ""
    return (
        f"gives {attributed[0]!r} the accounting 'attributed', and has no `by_process` that "
        "measures it"
    )


def close_quietly(probe: Probe) -> None:
    """Close a probe that is not used; ignore a failure."""
    with contextlib.suppress(PluginError):
        close = partial(methodcaller("close"), probe)
        guarded(close, whom=f"probe {type(probe).__name__}", hook="close", seconds=1.0)
