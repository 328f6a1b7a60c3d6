"""Checks the plugins that a file names, and their options, against what is installed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosrm.config.checking import validated
from rosrm.config.documents import Node, Problems
from rosrm.config.plain import to_plain
from rosrm.core.plugin_calls import TITLES
from rosrm.errors import ConfigError
from rosrm.registry import Registry


class PluginCheck:
    """Looks every chosen plugin up; without a registry it lets names and options pass as they are.

    Options come back as plain JSON values in base units, as the runtimes take them.
    """

    def __init__(self, registry: Registry | None, problems: Problems) -> None:
        self._registry = registry
        self._problems = problems

    def has(self, kind: str, name: str) -> bool:
        """Whether a plugin is installed; without a registry it is taken to be."""
        return self._registry is None or name in self._registry.names(kind)

    def choice(
        self, kind: str, name: str, named: Node, options: Node | None, *, own: bool = False
    ) -> Mapping[str, Any]:
        """The options of one chosen plugin.

        Args:
            kind: as in `Registry.offer`.
            name: of the offer.
            named: where the file names it.
            options: as the file gives them; None: it gives none.
            own: they are of one process.
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
        wanted = getattr(offer, "own_options", None) if own else None
        return self._options(f"options of {TITLES[kind]} {name!r}", wanted or offer.options, given)

    def _options(self, title: str, wanted: type[Any], given: Node) -> Mapping[str, Any]:
        try:
            value = validated(wanted, given, self._problems, title)
            return {} if value is None else dict(to_plain(value))
        except Exception as fault:  # noqa: BLE001 - the annotations are a plugin's, not ours
            self._problems.add(given.place, f"{title} cannot be checked: {fault}")
            return {}

    def by_name(self, kind: str, chosen: Node | None) -> dict[str, Mapping[str, Any]]:
        """The options of each plugin in a list of names or a mapping from name to options."""
        if chosen is None:
            return {}
        if isinstance(chosen.value, tuple):
            named = {str(node.value): (node, None) for node in chosen.value}
            return {name: self.choice(kind, name, *pair) for name, pair in named.items()}
        return {
            name: self.choice(kind, name, options, options)
            for name, options in chosen.items.items()
        }
