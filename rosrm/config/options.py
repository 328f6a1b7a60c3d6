"""Check of plugin names and options in a file against the installed plugins."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Any, Final, Literal, get_args, get_type_hints

from rosrm.config.checking import near, validated
from rosrm.config.documents import Node, Problems
from rosrm.errors import ConfigError, PluginError
from rosrm.extensions.contracts import Capabilities
from rosrm.extensions.declared_fields import (
    MaybeCapabilities,
    container_conflict,
    no_capabilities,
    standby_conflict,
)
from rosrm.extensions.guard import guarded
from rosrm.extensions.plugin_calls import TITLES
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import IsResource
from rosrm.model.codec import to_plain
from rosrm.model.rows import PluginKind
from rosrm.model.values import ProcessSpec

#: Entry of `probes` that selects all default probes.
DEFAULT_PROBES: Final = "default"

#: Field of an offer with the type of options: for all processes, for one process, or for one host.
OptionsOf = Literal["options", "own_options", "host_options"]


def _holds_resources(hint: Any) -> bool:
    """Return True if the keys or items of an option are annotated as names of resources."""
    marks = getattr(next(iter(get_args(hint)), None), "__metadata__", ())
    return any(isinstance(mark, IsResource) for mark in marks)


class PluginCheck:
    """Check of every chosen plugin; without a registry, names and options are not checked.

    Options are returned as plain JSON values in base units, as the runtimes expect them.
    """

    def __init__(self, registry: Registry | None, problems: Problems) -> None:
        self._registry = registry
        self._problems = problems

    def has(self, kind: PluginKind, name: str) -> bool:
        """Return True if a plugin is installed; always True without a registry."""
        return self._registry is None or name in self._registry.names(kind)

    def standby_fault(self, spec: ProcessSpec) -> str:
        """Return why a process cannot have its requested standby; "": no reason is known."""
        able = self._capabilities(spec)
        return "" if able is None else standby_conflict(spec, able, self._known)

    def container_fault(self, spec: ProcessSpec) -> str:
        """Return why a process in a container cannot move by its strategy; "": it can."""
        able = self._capabilities(spec)
        return "" if able is None else container_conflict(spec, able)

    def _capabilities(self, spec: ProcessSpec) -> MaybeCapabilities | None:
        """Return the capabilities of a process; None: the strategy cannot be checked here."""
        if spec.migration.strategy is None:
            return no_capabilities(spec)
        if self._registry is None or not self.has("migration", spec.migration.strategy):
            return None  # `choice` has noted that it is not installed
        return self._registry.capabilities_of()(spec)

    @cached_property
    def _known(self) -> Mapping[str, Capabilities]:
        return {} if self._registry is None else self._registry.capabilities()

    def choice(
        self, kind: PluginKind, name: str, named: Node, options: Node | None, *,
        part: OptionsOf = "options",
    ) -> Mapping[str, Any]:  # fmt: skip
        """Return the options of one chosen plugin.

        Args:
            kind: kind of the plugin.
            name: name of the offer.
            named: node of the name in the file.
            options: node of the options in the file; None: no options.
            part: field of the offer with the type of the options.
        """
        given = options if options is not None and options.value is not None else None
        plain = {} if given is None or not given.items else given.plain()
        if self._registry is None:
            return dict(plain)
        try:
            offer = self._registry.offer(kind, name)
        except ConfigError as error:
            self._problems.add(named.key_place or named.place, str(error))
            return dict(plain)
        if given is None:
            given = Node({}, named.place)
        wanted = getattr(offer, part, None)
        return self._options(f"options of {TITLES[kind]} {name!r}", wanted or offer.options, given)

    def _options(self, title: str, wanted: type[Any], given: Node) -> Mapping[str, Any]:
        def checked() -> Mapping[str, Any]:
            value = validated(wanted, given, self._problems, title)
            self._check_names(wanted, given, title)
            return {} if value is None else dict(to_plain(value))

        try:  # the annotations and the checks are a plugin's, not ours
            return guarded(checked, whom=title, hook="options")
        except PluginError as fault:
            self._problems.add(given.place, f"{title} cannot be checked: {fault}")
            return {}

    def _check_names(self, wanted: type[Any], given: Node, title: str) -> None:
        """Note unknown names of resources in options that are annotated to hold such names."""
        for name, hint in get_type_hints(wanted, include_extras=True).items():
            node = given.child(name)
            if node is not None and _holds_resources(hint):
                self.check_resources(node, f"{title}: {name}")

    def check_resources(
        self, named: Node | None, where: str, probes: Collection[str] | None = None
    ) -> None:
        """Note names of resources that no installed probe reads, or none of the chosen ones.

        Args:
            named: a mapping from resources, or a list of resources.
            where: prefix of each message.
            probes: names of the chosen probes; None: all installed probes.
        """
        if self._registry is None or named is None:
            return
        nodes = named.value if isinstance(named.value, tuple) else ()
        items = [(str(node.value), node) for node in nodes] or list(named.items.items())
        for name, node in items:
            reads = self._registry.probes_of(name)
            if not reads and self._registry.lost_probes():
                continue  # one of them may read it
            if not reads:
                note = f"unknown resource {name!r}{near(name, self._registry.resources())}"
                note += " (resources of the probes that are installed here)"
            elif probes is not None and not set(reads) & set(probes):
                note = f"{name!r} is read by the probe {reads[0]!r}, which is not among `probes`"
            else:
                continue
            self._problems.add(node.key_place or node.place, f"{where}: {note}")

    def by_name(
        self, kind: PluginKind, chosen: Node | None, *, part: OptionsOf = "options"
    ) -> dict[str, Mapping[str, Any]]:
        """Return the options of each plugin in a list of names or a mapping from name to options.

        The name `default` selects the default probes; `part` is that of `choice`.
        """
        if chosen is None:
            return {}
        if isinstance(chosen.value, tuple):
            given: Mapping[str, tuple[Node, Node | None]] = {
                str(node.value): (node, None) for node in chosen.value
            }
        else:
            given = {name: (options, options) for name, options in chosen.items.items()}
        found: dict[str, Mapping[str, Any]] = {}
        for name, pair in given.items():
            if kind == "probe" and name == DEFAULT_PROBES and self._registry is not None:
                found = {**self._registry.default_probes(), **found}
            else:
                found[name] = self.choice(kind, name, *pair, part=part)
        return found
