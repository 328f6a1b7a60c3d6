"""Registry of plugins: selection by name, creation of their objects, states for listings.

This module does not import pydantic, because the runtimes of master and slave import it. They get
checked options; `rosrm.config.options` checks the options in a file against the same offers.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any, Final, TypeVar, cast

from rosrm.errors import ConfigError, PluginError, SkipPlugin
from rosrm.extensions import guard
from rosrm.extensions.answers import whole
from rosrm.extensions.contracts import (
    Capabilities,
    CheckpointPolicy,
    FilterOffer,
    HostChecking,
    HostLabelling,
    LauncherContext,
    LauncherOffer,
    MigrationOffer,
    MigrationStrategy,
    PeriodicImaging,
    PlacementFilter,
    Probe,
    ProbeContext,
    ProbeOffer,
    ScoringOffer,
    ScoringPolicy,
)
from rosrm.extensions.declared_fields import (
    Declared,
    MaybeCapabilities,
    unknown_capabilities,
)
from rosrm.extensions.discovery import (
    Broken,
    ChosenOffer,
    Loaded,
    Offer,
    Offered,
    PluginSource,
    definition,
    load_addresses,
    load_objects,
)
from rosrm.extensions.guard import Crash, guarded, limit_of_one_call, note_versions
from rosrm.extensions.guarded_sink import GuardedSink
from rosrm.extensions.installed import PluginAddress, installed_plugins
from rosrm.extensions.made import (
    DraftedProbe,
    MadeLauncher,
    MadeLaunchers,
    OfferedExecutor,
    ProbeList,
    Probes,
    close_quietly,
    missing_method,
    taken_labels,
    taken_resources,
)
from rosrm.extensions.options import merged_options
from rosrm.extensions.placement import ScoringLink, SelectedFilter
from rosrm.extensions.plugin_calls import TITLES, Answers, Plugin, PluginCalls, implements, titled
from rosrm.extensions.sinks import EventSink
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.rows import PluginKind, PluginRow, PluginState
from rosrm.model.values import (
    EMPTY,
    MigrationPolicy,
    ProcessSpec,
)
from rosrm.wording import counted, get_close_matches, sanitized

#: Distribution with rosrm's own plugins of each kind, for messages if none is installed.
_SHIPPED_IN: Final[Mapping[PluginKind, str]] = {
    "probe": "rosrm-resources",
    "scoring": "rosrm-scoring",
    "migration": "rosrm-migration",
    "checkpoint": "rosrm-checkpoint",
    "sink": "rosrm-alerts",
}

#: Kinds of the plugins that a master uses.
MASTER_KINDS: Final[tuple[PluginKind, ...]] = ("scoring", "filter", "migration", "checkpoint")
#: Kinds of the plugins that slaves use.
SLAVE_KINDS: Final[tuple[PluginKind, ...]] = ("probe", "migration", "launcher")

#: Highest number of broken plugins in a message if the intended one is unknown.
_MOST_BROKEN: Final = 3

_NO_CAPABILITIES: Final = Capabilities()
#: Most answers on capabilities in memory, because each process may have options of its own.
_MOST_ANSWERS: Final = 10_000

_log = logging.getLogger("rosrm.plugins")

#: Resources that have a limit by default, so a host that does not measure them gets no work.
LIMITED: Final = ("cpu", "disk", "memory")
#: Prefix of the name of a probe that stands for a broken plugin.
_LOST: Final = "probes-of-"

NameToOptions = Mapping[str, Mapping[str, Any]]
T = TypeVar("T")


class Registry:
    """The plugins of this installation; `discover` creates it.

    Attributes:
        calls: guard and record of the calls of the plugins that this process uses.
    """

    def __init__(self, loaded: Loaded) -> None:
        self._offers: dict[Plugin, Offered] = {}
        self._broken: list[Broken] = list(loaded.broken)
        self._outcome: dict[Plugin, tuple[PluginState, str]] = {}
        self.calls = PluginCalls(limit_of_one_call)
        self._keep_single(loaded.offers)
        note_versions({
            titled(*key): offered.source.distribution for key, offered in self._offers.items()
        })  # fmt: skip
        self._refuse_shared_executors()

    @classmethod
    def discover(cls) -> Registry:
        """Find and load the installed plugins.

        A broken plugin raises nothing and is listed with its reason.
        """
        return cls.load(installed_plugins())

    @classmethod
    def load(
        cls, addresses: Iterable[PluginAddress], kinds: Collection[PluginKind] | None = None
    ) -> Registry:
        """Load plugins at known addresses, as `discover` does.

        Args:
            kinds: those whose offers are needed; None: all. No hook of another kind is called.
        """
        return cls(load_addresses(addresses, kinds))

    @classmethod
    def of(cls, **plugins: object) -> Registry:
        """Return a registry of modules or objects, without an installation (for tests)."""
        return cls(load_objects(plugins))

    def note_crashes(self, crashes: Iterable[Crash]) -> None:
        """Log and record in which calls of plugins a former process has ended."""
        known = {titled(*key): key for key in self._offers}
        for crash in crashes:
            _log.warning("%s: %s", crash.whom, crash.text)
            if crash.whom in known:
                self.calls.note(known[crash.whom], "", crash.text)

    # --- offers -------------------------------------------------------------------------------

    @property
    def broken(self) -> Sequence[Broken]:
        """Return the faults of plugins and offers."""
        return tuple(self._broken)

    def names(self, kind: PluginKind) -> tuple[str, ...]:
        """Return the names of all offers of one kind."""
        return tuple(sorted(name for of_kind, name in self._offers if of_kind == kind))

    def offer(self, kind: PluginKind, name: str) -> ChosenOffer:
        """Return the offer of a name; raise `ConfigError` with the names that exist."""
        return cast(ChosenOffer, self._offered(kind, name).offer)

    def resources(self) -> tuple[str, ...]:
        """Return the names of all resources that the installed probes may read."""
        return tuple(sorted({name for offer in self._probe_offers() for name in offer.resources}))

    def probes_of(self, resource: str) -> tuple[str, ...]:
        """Return the names of the probes that may read a resource."""
        return tuple(offer.name for offer in self._probe_offers() if resource in offer.resources)

    def _probe_offers(self) -> list[ProbeOffer]:
        return [cast(ProbeOffer, self.offer("probe", name)) for name in self.names("probe")]

    def default_probes(self) -> NameToOptions:
        """Return the default probes of a host without configured ones, without options.

        A broken plugin that may have offered some counts as a probe that cannot be created, so the
        host runs, reports the reason, and gets no work.

        Raises:
            ConfigError: none is installed.
        """
        for name, broken in self.lost_probes().items():
            self._offers["probe", name] = _lost(name, broken)
        chosen = {offer.name: EMPTY for offer in self._probe_offers() if offer.default}
        if not chosen:
            raise ConfigError(
                "no probe is installed, so this host could not be measured. "
                "Install rosrm-resources, or write `probes: {}` to run without."
                + self._broken_note("probe")
            )
        return chosen

    def lost_probes(self) -> dict[str, Broken]:
        """Return the broken plugins that may have offered default probes, each under a free name.

        Empty if the other default probes read each resource that has a limit by default.
        """
        offers = [offer for offer in self._probe_offers() if offer.default]
        read = {name for offer in offers if not _is_lost(offer) for name in offer.resources}
        if read.issuperset(LIMITED):
            return {}
        might = [one for one in self._broken if one.kind in ("", "probe")]
        return {
            _LOST + re.sub(r"[^\w.-]", "-", one.name or one.source.plugin): one for one in might
        }

    def rows(self, *kinds: PluginKind, host: str = "") -> list[PluginRow]:
        """Return one row for each offer and each fault of these kinds (without kinds: of all).

        The state is "available" until the object was created, then "selected", "absent" or
        "broken".
        """
        rows = []
        for (kind, name), offered in sorted(self._offers.items()):
            state, reason = self._outcome.get((kind, name), ("available", offered.offer.summary))
            reason = sanitized(reason)
            rows.append(PluginRow(kind, name, offered.source.distribution, state, reason, host))
        for broken in self._broken:
            kind, name = broken.kind or "plugin", broken.name or broken.source.plugin
            reason = sanitized(broken.reason)
            rows.append(PluginRow(kind, name, broken.source.distribution, "broken", reason, host))
        return [row for row in rows if not kinds or row.kind in (*kinds, "plugin")]

    # --- creation -----------------------------------------------------------------------------

    def scoring(self, name: str, options: Mapping[str, Any] = EMPTY) -> ScoringPolicy:
        """Create a scoring policy; raises `ConfigError` or `PluginError`."""
        return cast(ScoringPolicy, self._required("scoring", name, options))

    def link(
        self, name: str, options: Mapping[str, Any], weight: float = 1.0,
        *, seconds: float | None = None,
    ) -> ScoringLink:  # fmt: skip
        """Create a scoring policy as a link of a chain; raises as `scoring` does.

        Args:
            name: of the offer.
            options: of the policy.
            weight: factor of its scores.
            seconds: time-out of each call of the plugin; None: `LOADING_LIMIT`.
        """
        offer = cast(ScoringOffer, self.offer("scoring", name))
        made = self._required("scoring", name, options, seconds=seconds)
        return ScoringLink(name, cast(ScoringPolicy, made), weight, tuple(offer.reads))

    def filters(self, chosen: NameToOptions) -> tuple[SelectedFilter, ...]:
        """Create placement filters, in this order; raises as `scoring` does."""
        return tuple(self._filter(name, options) for name, options in chosen.items())

    def _filter(self, name: str, options: Mapping[str, Any]) -> SelectedFilter:
        offer = cast(FilterOffer, self.offer("filter", name))
        made = cast(PlacementFilter, self._required("filter", name, options))
        return SelectedFilter(name, made, offer.permanent, tuple(offer.reads))

    def checkpoint(
        self, name: str | None, options: Mapping[str, Any] = EMPTY
    ) -> CheckpointPolicy | None:
        """Create a checkpoint policy, None for none; raises `ConfigError` or `PluginError`."""
        if name is None:
            return None
        return cast(CheckpointPolicy, self._required("checkpoint", name, options))

    def sink(self, name: str, options: Mapping[str, Any] = EMPTY, shown: str = "") -> GuardedSink:
        """Create an event sink; raises `ConfigError` or `PluginError`.

        Args:
            name: of the offer.
            options: of the sink.
            shown: its name for users; "": that of the offer.
        """
        made = cast(EventSink, self._required("sink", name, options))
        return GuardedSink(shown or name, made)

    def migrations(self, chosen: NameToOptions) -> dict[str, MigrationStrategy]:
        """Create migration strategies by name, in this order; raises as `scoring` does."""
        made = {
            name: cast(MigrationStrategy, self._required("migration", name, options))
            for name, options in chosen.items()
        }
        for name, strategy in made.items():
            self._check_executors(name, strategy)
        return made

    def _check_executors(self, name: str, strategy: object) -> None:
        """Refuse a strategy with a `host_check` or `discard` that its own offer lacks."""
        own = self._strategy(name).executors
        for kind, named in ((HostChecking, "host_check"), (PeriodicImaging, "discard")):
            if not implements(strategy, kind):
                continue
            executor = self._guarded("migration", name, named, partial(getattr, strategy, named))
            if not (isinstance(executor, str) and executor in own):
                there = ", ".join(sorted(own)) or "none"
                fault = f"its `{named}` is {executor!r:.100}, which its offer lacks; "
                raise self._fault("migration", name, f"{fault}there are: {there}")

    def declared(self, chosen: NameToOptions) -> Declared:
        """Return the declarations in the offers of migration strategies."""
        return Declared(
            options_of=self._options(chosen),
            capabilities_of=self.capabilities_of(chosen),
            capabilities=self.capabilities(chosen),
            executors={name: frozenset(self._strategy(name).executors) for name in chosen},
            brought_by={
                name: self._offers["migration", name].source.distribution for name in chosen
            },
        )

    def _options(self, chosen: NameToOptions) -> Callable[[str, ProcessSpec], Any]:
        """Return the function that merges and parses the options of a strategy for a process."""

        def merged(strategy: str, own: Mapping[str, Any]) -> Any:
            offer, common = self._strategy(strategy), chosen.get(strategy, EMPTY)
            return merged_options(offer.own_options or offer.options, common, own)

        common = cache(partial(merged, own=EMPTY))  # most processes have no own options

        def options(strategy: str, spec: ProcessSpec) -> Any:
            own = spec.migration.options if spec.migration.strategy == strategy else EMPTY
            return merged(strategy, own) if own else common(strategy)

        return options

    def capabilities(self, chosen: NameToOptions = EMPTY) -> dict[str, Capabilities]:
        """Return the known capabilities of each installed strategy, without a process's options."""
        of = self.capabilities_of(chosen)
        names = self.names("migration")
        found = {name: of(ProcessSpec("", migration=MigrationPolicy(name))) for name in names}
        return {name: able for name, able in found.items() if isinstance(able, Capabilities)}

    def capabilities_of(
        self, chosen: NameToOptions = EMPTY
    ) -> Callable[[ProcessSpec], MaybeCapabilities]:
        """Return a function that returns the capabilities of the strategy of a process.

        A strategy is asked until it answers, once for the same options. Its capabilities are
        unknown until then, and where it is not installed.

        Args:
            chosen: strategies with their options for all processes.
        """
        found = self.capabilities_or_fault(chosen)
        answers: dict[tuple[str, str], Capabilities] = {}

        def known(spec: ProcessSpec) -> MaybeCapabilities:
            name = spec.migration.strategy
            if name is None:
                return _NO_CAPABILITIES
            if ("migration", name) not in self._offers:
                return unknown_capabilities(
                    name, f"{name!r} is not installed here: install it and start the master again"
                )
            key = name, repr(spec.migration.options)
            if key not in answers:
                try:
                    answer = found(spec)
                except PluginError as fault:  # the guard has recorded it
                    return unknown_capabilities(name, fault)
                if len(answers) >= _MOST_ANSWERS:
                    del answers[next(iter(answers))]
                answers[key] = answer
            return answers[key]

        return known

    def capabilities_or_fault(
        self, chosen: NameToOptions = EMPTY
    ) -> Callable[[ProcessSpec], Capabilities]:
        """Return a function as `capabilities_of`, which raises `PluginError` if a strategy fails.

        A start needs it, because without its launcher the process would be another one. A host
        where the strategy of a process is not installed has none of its launchers either, but a
        plugin that does not load may offer both.
        """
        options = self._options(chosen)

        def found(spec: ProcessSpec) -> Capabilities:
            name = spec.migration.strategy or ""
            if ("migration", name) not in self._offers:
                might = self._might_offer("migration", name) if name else []
                if might:
                    raise PluginError(
                        f"a plugin that does not load here may offer it; correct it, and start "
                        f"the slave again: {_faults(might)}"
                    )
                return _NO_CAPABILITIES
            declared = self._strategy(name).capabilities
            if isinstance(declared, Capabilities):
                return declared
            function = declared

            def ask() -> Capabilities:
                return cast(Capabilities, whole(function(options(name, spec)), Capabilities))

            return self.calls.ask("migration", name, "capabilities", ask)

        return found

    def _strategy(self, name: str) -> MigrationOffer:
        return cast(MigrationOffer, self.offer("migration", name))

    def launchers(self, context: LauncherContext) -> MadeLaunchers:
        """Create the launchers of a host; list those that cannot be created with the reason."""
        made: dict[str, MadeLauncher] = {}
        absent: dict[str, str] = {}
        broken: dict[str, str] = {}
        for name in self.names("launcher"):
            try:
                made[name] = self.launcher(name, context)
            except SkipPlugin as skip:
                absent[name] = str(skip)
            except PluginError as fault:
                broken[name] = str(fault)
        return MadeLaunchers(made, absent, broken)

    def launcher(self, name: str, context: LauncherContext) -> MadeLauncher:
        """Create a launcher; may be called in any thread.

        Raises:
            SkipPlugin: it is absent on this host.
            PluginError: it cannot be created.
        """
        offer = cast(LauncherOffer, self._offered("launcher", name).offer)
        try:
            launcher = self._create("launcher", name, offer, context)
        except SkipPlugin as skip:
            self._outcome["launcher", name] = ("absent", str(skip))
            raise
        return MadeLauncher(launcher, tuple(offer.variables))

    def executors(self, chosen: NameToOptions = EMPTY) -> dict[str, OfferedExecutor]:
        """Return the executors that plans may name on this host, from all migration offers.

        Args:
            chosen: the options of this host by strategy.

        Raises:
            ConfigError: for an unknown strategy or an invalid option.
        """
        options = {name: self._host_options(name, given) for name, given in chosen.items()}
        return {
            executor: OfferedExecutor(name, function, options.get(name, EMPTY))
            for name in self.names("migration")
            for executor, function in self._strategy(name).executors.items()
        }

    def _host_options(self, name: str, given: Mapping[str, Any]) -> Mapping[str, Any]:
        wanted = self._strategy(name).host_options
        try:
            return cast(Mapping[str, Any], self._guarded(
                "migration", name, "host_options", lambda: to_plain(from_plain(wanted, given)),
                (ValueError,),
            ))  # fmt: skip
        except ValueError as wrong:
            raise ConfigError(f"strategies: options of {name!r}: {wrong}") from wrong

    def broken_strategies(self) -> dict[str, str]:
        """Return the name of each broken migration offer, with the reason."""
        return {
            broken.name or broken.source.plugin: f"{broken.source}: {broken.reason}"
            for broken in self._broken
            if broken.kind == "migration"
        }

    def probes(self, chosen: NameToOptions | None, context: ProbeContext) -> Probes:
        """Create the probes of a host, the default ones for None.

        A probe that raises `SkipPlugin` is absent. A probe that fails in any other way is replaced
        by a `FailedProbe`.

        Raises:
            ConfigError: for an unknown name or option.
        """
        wanted = self.chosen_probes(chosen)
        listed = self.probe_list(wanted)
        for name, options in wanted.items():
            self.add_probe(listed, name, partial(self.draft_probe, name, options, context))
        return listed.probes

    def chosen_probes(self, chosen: NameToOptions | None) -> NameToOptions:
        """Return the probes of a host with their options, the default ones for None.

        Raises:
            ConfigError: a probe is unknown, or none is installed.
        """
        wanted = self.default_probes() if chosen is None else chosen
        for name in wanted:
            self._offered("probe", name)
        return wanted

    def probe_list(self, wanted: Iterable[str]) -> ProbeList:
        """Return a list to which each of these probes can be added when it is created."""
        offers = {name: cast(ProbeOffer, self.offer("probe", name)) for name in wanted}
        return ProbeList(offers, self._not_returned)

    def _not_returned(self, name: str) -> str:
        create = cast(ProbeOffer, self.offer("probe", name)).create
        source = self._offers["probe", name].source
        return f"{source}: `create` ({definition(create)}) has not returned yet"

    def draft_probe(
        self, name: str, options: Mapping[str, Any], context: ProbeContext
    ) -> DraftedProbe:
        """Create a probe and read its description; may be called in any thread.

        Raises:
            SkipPlugin: it is absent on this host.
            ConfigError: an option is invalid.
            PluginError: it cannot be created.
        """
        offer = cast(ProbeOffer, self.offer("probe", name))
        probe = self._make("probe", name, options, context)

        def described() -> DraftedProbe:
            resources = taken_resources(probe.resources)
            labels = taken_labels(probe.labels) if implements(probe, HostLabelling) else EMPTY
            return DraftedProbe(offer, probe, resources, labels, hasattr(probe, "by_process"))

        try:
            return self._guarded("probe", name, "resources` or `labels", described)
        except PluginError:
            close_quietly(probe)
            raise

    def add_probe(self, listed: ProbeList, name: str, draft: Callable[[], DraftedProbe]) -> None:
        """Add a probe to the list, or the reason why there is none.

        Args:
            draft: returns the created probe, or raises as `draft_probe`.

        Raises:
            ConfigError: an option is invalid.
        """
        try:
            drafted = draft()
            try:
                compared = partial(_fault_beside, listed, drafted)
                fault = self._guarded("probe", name, "resources` or `labels", compared)
                if fault:
                    raise self._fault("probe", name, fault)
            except PluginError:
                close_quietly(drafted.probe)
                raise
            listed.add(drafted)
        except SkipPlugin as skip:
            listed.leave_out(name, str(skip))
            self._outcome["probe", name] = ("absent", str(skip))
        except PluginError:
            reason = self._outcome["probe", name][1]
            listed.fail(name, f"{self._offers['probe', name].source}: {reason}")

    def _guarded(
        self, kind: PluginKind, name: str, hook: str, call: Callable[[], T], lets: Answers = ()
    ) -> T:
        """Return the answer of an object that an offer created; `PluginError` marks it broken."""
        try:
            return guarded(call, whom=titled(kind, name), hook=hook, lets=lets)
        except PluginError as fault:
            own = not fault.was_raised  # rosrm's sentence on an invalid answer
            raise self._fault(
                kind, name, str(fault) if own else f"its `{hook}` raised {fault}"
            ) from fault

    def _required(
        self, kind: PluginKind, name: str, options: Mapping[str, Any], *,
        seconds: float | None = None,
    ) -> Any:  # fmt: skip
        """Create an object that the master needs, so that its absence here is an error."""
        try:
            return self._make(kind, name, options, seconds=seconds)
        except SkipPlugin as skip:
            self._outcome[kind, name] = ("absent", str(skip))
            raise ConfigError(f"{TITLES[kind]} {name!r} is absent here: {skip}") from skip

    def _make(
        self, kind: PluginKind, name: str, options: Mapping[str, Any], *more: Any,
        seconds: float | None = None,
    ) -> Any:  # fmt: skip
        offer, limit = self.offer(kind, name), _limit(seconds)
        try:
            settings = guarded(
                partial(from_plain, offer.options, options), whom=titled(kind, name),
                hook="options", seconds=limit, lets=(ValueError,),
            )  # fmt: skip
        except ValueError as wrong:
            raise ConfigError(f"options of {TITLES[kind]} {name!r}: {wrong}") from wrong
        except PluginError as fault:
            raise self._fault(kind, name, f"its options cannot be read: {fault}") from fault
        return self._create(kind, name, offer, settings, *more, seconds=limit)

    def _create(
        self, kind: PluginKind, name: str, offer: Offer, *given: Any, seconds: float | None = None
    ) -> Any:
        create, limit = cast(Callable[..., Any], offer.create), _limit(seconds)

        def late() -> str:
            return (
                f"it did not return within {limit:g} s; correct what blocks it, or "
                f"leave {name!r} out of the configuration"
            )

        def made() -> tuple[Any, str]:
            thing = create(*given)
            return thing, missing_method(kind, thing)

        try:
            thing, lacks = guarded(
                made, whom=titled(kind, name), hook="create", seconds=limit,
                late=late, lets=(SkipPlugin, ConfigError),  # not a fault of the plugin
            )  # fmt: skip
        except PluginError as fault:
            reason = f"`create` ({definition(create)}) raised {fault}"
            raise self._fault(kind, name, reason) from fault
        if lacks:
            raise self._fault(kind, name, f"`create` ({definition(create)}) made {lacks}")
        self._outcome[kind, name] = ("selected", offer.summary)
        return thing

    def _fault(self, kind: PluginKind, name: str, reason: str) -> PluginError:
        self._outcome[kind, name] = ("broken", reason)
        return PluginError(
            f"{TITLES[kind]} {name!r} of {self._offers[kind, name].source}: {reason}"
        )

    # --- lookup of names ----------------------------------------------------------------------

    def _keep_single(self, offers: Sequence[Offered]) -> None:
        """Keep the offers with a unique name, because a duplicate name is ambiguous."""
        for offered in offers:
            key = (offered.kind, offered.offer.name)
            same = [other for other in offers if (other.kind, other.offer.name) == key]
            if len(same) == 1:
                self._offers[key] = offered
            else:
                sources = list(dict.fromkeys(str(other.source) for other in same))
                reason = f"offered by {' and '.join(sources)}: uninstall all but one"
                if len(sources) == 1:
                    reason = f"offered {len(same)} times by {sources[0]}: rename all but one"
                self._broken.append(Broken(offered.source, reason, *key))

    def _refuse_shared_executors(self) -> None:
        """Mark offers with executors of equal names as broken, because orders have only the name.

        Offers with the same function may share its name.
        """
        owners: dict[str, list[str]] = {}
        for name in self.names("migration"):
            for executor in self._strategy(name).executors:
                owners.setdefault(executor, []).append(name)
        found: dict[str, str] = {}
        for executor, names in owners.items():
            for name in names:
                function = self._strategy(name).executors[executor]
                others = [
                    f"{other!r} of {self._offers['migration', other].source}"
                    for other in names
                    if self._strategy(other).executors[executor] is not function
                ]
                if others:
                    reason = f"its executor {executor!r} has the name of one of "
                    reason += f"{' and '.join(others)}: uninstall one, or rename the executor"
                    found.setdefault(name, reason)
        for name, reason in found.items():
            source = self._offers.pop(("migration", name)).source
            self._broken.append(Broken(source, reason, "migration", name))

    def _offered(self, kind: PluginKind, name: str) -> Offered:
        if (kind, name) in self._offers:
            return self._offers[kind, name]
        title, names = TITLES[kind], self.names(kind)
        near = get_close_matches(name, names, 1)
        meant = f"; did you mean {near[0]!r}?" if near else "."
        shipped = f"; {_SHIPPED_IN[kind]} has rosrm's own" if kind in _SHIPPED_IN else ""
        installed = f"Installed: {', '.join(names)}." if names else f"None is installed{shipped}."
        raise ConfigError(
            f"unknown {title} {name!r}{meant} {installed}{self._broken_note(kind, name)}"
        )

    def _might_offer(self, kind: PluginKind, name: str) -> list[Broken]:
        """Return the broken plugins that may have an offer of this name if they load."""
        return [b for b in self._broken if b.kind in ("", kind) and b.name in ("", name)]

    def _broken_note(self, kind: PluginKind, name: str = "") -> str:
        """Return the faults of the broken plugin that may be meant, and the number of the others.

        A plugin is matched by the name of its offer or, if that is unknown, by its own name.
        """
        might = [b for b in self._broken if b.kind in ("", kind)]
        meant = [b for b in might if not name or name == b.name]
        if not meant:
            meant = [b for b in might if not b.name and _is_named_like(b.source, name)]
        if not meant:  # any plugin without a known offer may be meant
            meant = [b for b in might if not b.name][:_MOST_BROKEN]
        note = f" Broken: {_faults(meant)}." if meant else ""
        others = len(might) - len(meant)
        if not others:
            return note
        many = counted(others, "plugin is", "plugins are")
        return f"{note} {many} broken{' besides' if note else ''}: see `rosrm plugins --local`."


def _is_lost(offer: ProbeOffer) -> bool:
    return offer.name.startswith(_LOST)


def _lost(name: str, broken: Broken) -> Offered:
    """Return the offer of a probe that stands for those of a broken plugin, and is not created."""

    def create(_options: Any, _context: ProbeContext) -> Probe:
        raise PluginError(broken.reason)

    offer = ProbeOffer(name, create, summary=broken.reason, default=True, resources=LIMITED)
    return Offered("probe", offer, broken.source)


def _limit(seconds: float | None) -> float:
    return guard.LOADING_LIMIT if seconds is None else seconds


def _fault_beside(listed: ProbeList, drafted: DraftedProbe) -> str:
    """Return why a host cannot have a probe beside the others of the list; "": it can."""
    fault = listed.fault_of(drafted)
    kind = type(drafted.probe)
    return f"{kind.__name__} ({definition(kind)}) {fault}" if fault else ""


def _faults(broken: Iterable[Broken]) -> str:
    return "; ".join(dict.fromkeys(f"{one.source}: {one.reason}" for one in broken))


def _is_named_like(source: PluginSource, name: str) -> bool:
    """Return True if a broken plugin without known offers may have an offer of this name."""
    words = {word for text in (source.plugin, source.distribution) for word in _words(text)}
    return bool(words & set(_words(name))) or bool(get_close_matches(name, [source.plugin], 1))


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[^a-z]+", text.lower()) if word not in ("", "rosrm")]
