"""Discovery of installed plugins: import, call of the hooks, checks of the offers.

A plugin that cannot be imported, raises in a hook or misspells a hook is broken. It is listed with
its distribution and with name and place of the hook, and does not affect other plugins.
"""

from __future__ import annotations

import contextlib
import inspect
import logging
import re
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from itertools import islice
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any, Final, Literal, TypeAlias, TypeVar, get_args, get_type_hints

import pluggy

from rosrm.errors import PluginError, plain_text
from rosrm.extensions import guard, hookspecs
from rosrm.extensions.answers import whole
from rosrm.extensions.contracts import (
    Capabilities,
    CheckpointOffer,
    FilterOffer,
    LauncherOffer,
    MigrationOffer,
    ProbeOffer,
    ScoringOffer,
)
from rosrm.extensions.declared_fields import SPEC_FIELDS
from rosrm.extensions.installed import GROUP, PluginAddress
from rosrm.extensions.sinks import SinkOffer
from rosrm.model.rows import PluginKind
from rosrm.wording import get_close_matches

T = TypeVar("T")
#: Offers that the configuration chooses by name, with options.
ChosenOffer: TypeAlias = (
    "ProbeOffer | ScoringOffer | FilterOffer | MigrationOffer | CheckpointOffer | SinkOffer"
)
Offer: TypeAlias = "ChosenOffer | LauncherOffer"

#: Hook to the kind and the type of its offers.
HOOKS: Final[Mapping[str, tuple[PluginKind, type[Any]]]] = {
    "register_probes": ("probe", ProbeOffer),
    "register_scoring_policies": ("scoring", ScoringOffer),
    "register_filters": ("filter", FilterOffer),
    "register_migration_strategies": ("migration", MigrationOffer),
    "register_checkpoint_policies": ("checkpoint", CheckpointOffer),
    "register_launchers": ("launcher", LauncherOffer),
    "register_event_sinks": ("sink", SinkOffer),
}

#: Seconds after which a warning names a plugin that is still being loaded.
SLOW_LOADING: Final = 5.0

#: Names of offers, which are written in files and shown in tables.
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_NAME_FORM: Final = (
    'at most 64 letters, digits, "_", "-" and ".", the first of them a letter or digit'
)
#: Maximum number of offers of one hook.
_MOST_OFFERS: Final = 256
#: Least and highest value of a field of an offer, by its name.
_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "period": (0.001, 86_400.0), "deadline": (0.001, 86_400.0), "batch": (1, 10_000),
}  # fmt: skip
#: Names of environment variables.
_VARIABLE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")

_log = logging.getLogger("rosrm.plugins")


@dataclass(frozen=True)
class PluginSource:
    """Origin of a plugin: its entry point's name, its distribution's name and version."""

    plugin: str
    distribution: str = ""

    def __str__(self) -> str:
        return f"plugin {self.plugin!r}" + (f" of {self.distribution}" if self.distribution else "")


@dataclass(frozen=True)
class Offered:
    """One offer of a plugin."""

    kind: PluginKind
    offer: Offer
    source: PluginSource


@dataclass(frozen=True)
class Broken:
    """A fault of a plugin or offer; `kind` and `name`: "" if unknown."""

    source: PluginSource
    reason: str
    kind: PluginKind | Literal[""] = ""
    name: str = ""


@dataclass
class Loaded:
    """Offers and faults of the loaded plugins."""

    offers: list[Offered]
    broken: list[Broken]


def load_addresses(
    addresses: Iterable[PluginAddress], kinds: Collection[PluginKind] | None = None
) -> Loaded:
    """Load every plugin of an installation.

    Args:
        kinds: of the offers that are needed; None: all. No hook of another kind is called.
    """
    loaded = Loaded([], [])
    for address in addresses:
        source = PluginSource(address.name, address.distribution)
        _load(loaded, source, address.target, partial(resolve_name, address.target), kinds)
    return loaded


def load_objects(plugins: Mapping[str, object]) -> Loaded:
    """Load modules or objects as plugins, by name, without an installation (for tests)."""
    loaded = Loaded([], [])
    for name, plugin in plugins.items():
        _load(loaded, PluginSource(name), name, lambda plugin=plugin: plugin)  # type: ignore[misc]
    return loaded


def definition(function: object) -> str:
    """Return the place of a function's or class's definition, for messages; "" if unknown."""
    try:
        target: Any = inspect.unwrap(function)  # type: ignore[arg-type]
        return f"{inspect.getsourcefile(target)}:{inspect.getsourcelines(target)[1]}"
    except BaseException:  # noqa: BLE001 - no source, or an object with any attributes
        return ""


def _in_time(source: PluginSource, what: Callable[[], str], call: Callable[[], T]) -> T:
    """Return the answer of plugin code; warn when it is slow, and interrupt it when it hangs.

    `what` returns a description of the code; only warnings call it, because it may read a file.

    Raises:
        PluginError: as `guarded`.
    """
    limit = guard.LOADING_LIMIT

    def say() -> None:
        _log.warning(
            "%s is still being loaded after %g s: %s has not returned; it is ended after %g s",
            source, SLOW_LOADING, what(), limit,
        )  # fmt: skip

    timer = threading.Timer(SLOW_LOADING, say)
    timer.daemon = True
    timer.start()
    late = f"it did not return within {limit:g} s; move slow work into a thread of its own"
    try:
        # What the code prints must not mix with the output of a command, such as JSON.
        with contextlib.redirect_stdout(sys.stderr):
            return guard.guarded(
                call, whom=str(source), hook="import", seconds=limit, late=lambda: late
            )
    finally:
        timer.cancel()


def _load(
    loaded: Loaded, source: PluginSource, target: str, load: Callable[[], object],
    kinds: Collection[PluginKind] | None = None,
) -> None:  # fmt: skip
    guard.note_versions({str(source): source.distribution})

    def found() -> tuple[Mapping[str, Callable[..., Any]], list[str]]:
        plugin = load()
        marked = _marked(plugin)
        return marked, list(_misspelt(plugin, marked))

    try:
        marked, misspelt = _in_time(source, lambda: f"the import of {target}", found)
    except PluginError as fault:
        loaded.broken.append(Broken(source, f"does not import: {fault}"))
        return
    loaded.broken += [Broken(source, reason) for reason in misspelt]
    for hook, (kind, _) in HOOKS.items():
        if hook in marked and (kinds is None or kind in kinds):
            _take(loaded, source, hook, marked[hook])


def _marked(plugin: object) -> Mapping[str, Callable[..., Any]]:
    """Return the functions of a plugin that `@hookimpl` marks, by the hook that they implement."""
    marked: dict[str, Callable[..., Any]] = {}
    for name in dir(plugin):
        function = getattr(plugin, name, None)
        mark = getattr(function, f"{GROUP}_impl", None)
        if callable(function) and isinstance(mark, Mapping):
            marked[mark.get("specname") or name] = function
    return marked


def _misspelt(plugin: object, marked: Mapping[str, Callable[..., Any]]) -> Iterable[str]:
    for hook, function in marked.items():
        if hook not in HOOKS:
            near = get_close_matches(hook, HOOKS, 1)
            meant = f"; did you mean {near[0]!r}?" if near else "."
            yield (
                f"unknown hook {hook!r} ({definition(function)}){meant} Allowed: {', '.join(HOOKS)}"
            )
    for hook in HOOKS:
        unmarked = getattr(plugin, hook, None)
        if callable(unmarked) and hook not in marked:
            where = definition(unmarked)
            yield f"{hook} ({where}) lacks the mark @hookimpl (`from rosrm import hookimpl`)"


def _take(loaded: Loaded, source: PluginSource, hook: str, function: Callable[..., Any]) -> None:
    kind, wanted = HOOKS[hook]

    def place() -> str:
        return f"{hook} ({definition(function)})"

    def offers() -> list[tuple[Any, str, str]]:
        """Return each offer with its name and fault; reading them may run code of the plugin."""
        answer = _call(hook, function)
        if isinstance(answer, str) or not isinstance(answer, Sequence):
            given = "None" if answer is None else type(answer).__name__
            return [(None, "", f" returned {given}, not a list of {wanted.__name__}")]
        if len(answer) > _MOST_OFFERS:
            return [(None, "", f" returned {len(answer)} offers; allowed: {_MOST_OFFERS}")]
        return [_taken(one, wanted) for one in islice(answer, _MOST_OFFERS)]

    try:
        found = _in_time(source, place, offers)
    except PluginError as fault:
        reason = f"{place()} failed with {fault}"
        loaded.broken.append(Broken(source, reason, kind))
        return
    for offer, name, fault_found in found:
        if fault_found:
            loaded.broken.append(Broken(source, f"{place()}{fault_found}", kind, name))
        else:
            loaded.offers.append(Offered(kind, offer, source))


def _call(hook: str, function: Callable[..., Any]) -> Any:
    """Call one hook through pluggy, which checks the arguments; other plugins are not involved."""
    alone = pluggy.PluginManager(GROUP)
    alone.add_hookspecs(hookspecs)
    if parameters := inspect.signature(function).parameters:
        raise TypeError(f"it has the parameters {', '.join(parameters)}; a hook has none")
    alone.register(SimpleNamespace(**{hook: function}))
    answers = getattr(alone.hook, hook)()
    return answers[0] if answers else None  # pluggy omits an answer of None


def _taken(offer: object, wanted: type[Any]) -> tuple[Any, str, str]:
    """Return a copy of an offer that its plugin cannot change, its name, and its fault or ""."""
    name = plain_text(getattr(offer, "name", ""))[:64]
    copied, declared = offer, ""
    if type(offer) is wanted:  # a property of a subclass would run at each access
        try:
            copied = _copied(offer, wanted)
        except PluginError as fault:
            declared = str(fault)
    fault_found = _fault_of(copied, wanted, declared)
    return copied, name, fault_found and f": {fault_found}"


def _fault_of(offer: object, wanted: type[Any], declared: str) -> str:
    """Return why an offer cannot be used; "" if it can.

    Args:
        offer: a copy, unless it has a fault.
        wanted: type of offers of the hook.
        declared: first fault of a field against its declaration; "": none.
    """
    if type(offer) is not wanted:
        return f"offers {plain_text(repr(offer))}, which is not a {wanted.__name__}"
    name: object = getattr(offer, "name", None)
    if not isinstance(name, str) or not name.strip():
        return f"offers something without a name: {name!r}"
    if not _NAME.fullmatch(name):
        return f"offers the name {name!r}; allowed: {_NAME_FORM}"
    if not callable(getattr(offer, "create", None)):
        return f"{name!r}: `create` cannot be called"
    if isinstance(offer, LauncherOffer):  # the configuration does not choose these: no options
        if not declared:
            wrong = [one for one in offer.variables if not _VARIABLE.fullmatch(one)]
            declared = f"`variables` has the name {wrong[0]!r:.100}" if wrong else ""
        return f"{name!r}: {declared}" if declared else ""
    options: object = getattr(offer, "options", None)
    if not (isinstance(options, type) and is_dataclass(options)):
        return f"{name!r}: `options` is not a dataclass but {options!r}"
    bare = [
        f.name
        for f in fields(options)
        if f.init and f.default is MISSING and f.default_factory is MISSING
    ]
    if bare:
        return f"{name!r}: option {bare[0]!r} has no default"
    fault = _fault_of_reads(offer) if isinstance(offer, (ScoringOffer, FilterOffer)) else ""
    if isinstance(offer, MigrationOffer):
        fault = _fault_of_executors(offer) or _fault_of_capabilities(offer)
    fault = fault or declared
    return f"{name!r}: {fault}" if fault else ""


def _copied(offer: Any, wanted: type[Any]) -> Any:
    """Return a copy of an offer; raise `PluginError` for a field of another type or range."""
    hints = get_type_hints(wanted)
    values = {}
    for field in fields(wanted):
        value = whole(getattr(offer, field.name), hints[field.name], f"`{field.name}`")
        least, most = _RANGES.get(field.name, (0.0, 0.0))
        if most and not least <= value <= most:
            raise PluginError(f"`{field.name}` is {value!r}; allowed: {least:g} to {most:g}")
        values[field.name] = value
    return wanted(**values)


def _fault_of_executors(offer: MigrationOffer) -> str:
    """Return why the executors of a migration strategy cannot be called; "": they can."""
    executors: object = offer.executors
    if not isinstance(executors, Mapping):
        return f'`executors` is {executors!r}; a mapping is required, as {{"name": function}}'
    wrong = [
        f"executor {name!r} is {function!r}; a name and a function are required"
        for name, function in executors.items()
        if not isinstance(name, str) or not callable(function)
    ]
    return wrong[0] if wrong else ""


def _fault_of_capabilities(offer: MigrationOffer) -> str:
    """Return why the capabilities of a migration strategy cannot be read; "": they can."""
    declared: object = offer.capabilities
    if not isinstance(declared, Capabilities) and not callable(declared):
        return f"`capabilities` is {declared!r}; Capabilities(...) or a function is required"
    states = get_args(get_type_hints(Capabilities)["state"])
    if isinstance(declared, Capabilities) and declared.state not in states:
        return f"`capabilities.state` is {declared.state!r}; allowed: {', '.join(states)}"
    return ""


def _fault_of_reads(offer: ScoringOffer | FilterOffer) -> str:
    """Return the fault of the fields that a policy or filter declares to read; "": none."""
    reads: object = offer.reads
    if isinstance(reads, str) or not isinstance(reads, Sequence):
        return f'`reads` is {reads!r}; a tuple of field names is required, as ("name",)'
    for field in reads:
        if field not in SPEC_FIELDS:
            near = get_close_matches(str(field), SPEC_FIELDS, 1)
            meant = f"; did you mean {near[0]!r}?" if near else "."
            return f"`reads` has no field {field!r}{meant} Allowed: {', '.join(SPEC_FIELDS)}"
    return ""
