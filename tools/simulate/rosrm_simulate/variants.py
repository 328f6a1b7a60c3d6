"""Variants of a simulation: the given settings of a master, then with each change."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from rosrm.config.checking import near, validated
from rosrm.config.cluster import checked_cluster
from rosrm.config.documents import Node, Place, Problems, parse, read
from rosrm.config.merging import in_depth
from rosrm.config.settings import ClusterConfig
from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import Quantity

#: Sections of a cluster's settings that a variant can change.
SECTIONS: Final = (
    "scoring", "filters", "migration", "queue", "rebalance", "defaults", "liveness",
    "delivery_timeout",
)  # fmt: skip
_OF_A_VARIANT: Final = ("name", "hosts", *SECTIONS)


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of a comparison.

    Attributes:
        hosts: how many; None: those of the workload.
        cluster: the settings of its master.
    """

    name: str
    hosts: int | None
    cluster: ClusterConfig


def check_keys(node: Node, known: Sequence[str], where: str, problems: Problems) -> None:
    """Add a problem for every unknown key."""
    inside = f" in {where}" if where else ""
    for name, item in node.items.items():
        if name not in known:
            place = item.key_place or item.place
            problems.add(place, f"unknown key {name!r}{inside}{near(name, list(known))}")


def text_of(node: Node, key: str) -> str:
    """Return the text under a key; "" where there is none."""
    found = node.get(key)
    return found.value if found is not None and isinstance(found.value, str) else ""


def read_variants(path: str | Path) -> list[Node]:
    """Return the variants of a file of their own."""
    root, problems = read(path), Problems()
    check_keys(root, ("variants",), "", problems)
    problems.raise_any()
    return variants_of(root)


def variant_in_text(text: str) -> Node:
    """Return a variant given as text on the command line."""
    return parse(text, "--variant")


def variant_of_option(option: str, path: tuple[str, ...], value: str | int) -> Node:
    """Return the variant that sets one value, given by an option of the command line."""
    place = Place(f"{option} {value}", 0, 0)
    node = Node(value, place)
    for key in reversed(path):
        node = Node({key: node}, place)
    return node


def settings_node(config: Mapping[str, Any], name: str) -> Node:
    """Return the sections of recorded settings that a variant can change."""
    return parse(json.dumps({key: config[key] for key in SECTIONS if key in config}), name)


def load_variants(
    base: Node, changes: Sequence[Node], path: str | Path, registry: Registry,
    title: str = "as given",
) -> tuple[Variant, ...]:  # fmt: skip
    """Return the given settings, then those with each of the changes.

    Raises:
        ConfigError: lists all errors.
    """
    problems = Problems()
    check_keys(base, SECTIONS, "cluster", problems)
    for change in changes:
        if not isinstance(change.value, Mapping):
            problems.add(change.place, "a variant is a mapping, such as {scoring: {policy: …}}")
        check_keys(change, _OF_A_VARIANT, "a variant", problems)
    problems.raise_any()
    variants = [Variant(title, None, checked_cluster(base, path, registry))]
    wrong = []
    for change in changes:
        try:
            made = _variant(base, change, path, registry)
        except ConfigError as error:
            wrong.append(str(error))
            continue
        if made.name in [one.name for one in variants]:
            wrong.append(f"{change.place}: two variants are called {made.name!r}; name them")
        variants.append(made)
    if wrong:
        raise ConfigError("\n".join(wrong))
    return tuple(variants)


def _variant(base: Node, change: Node, path: str | Path, registry: Registry) -> Variant:
    problems = Problems()
    hosts = validated(_Hosts, _only(change, ("hosts",)), problems, "")
    problems.raise_any()
    own = _only(change, SECTIONS)
    under = base
    if change.get("scoring", "policy") is not None and base.get("scoring") is not None:
        # The options of one policy do not fit another.
        members = {key: item for key, item in base.items.items() if key != "scoring"}
        under = Node(members, base.place)
    name = text_of(change, "name") or _leaves_of(change)
    config = checked_cluster(in_depth(under, own), path, registry)
    return Variant(name, hosts.hosts if hosts else None, config)


@dataclass(frozen=True, slots=True)
class _Hosts:
    hosts: Annotated[int, Quantity(low=1, high=10_000, whole=True)] | None = None


def _only(node: Node, keys: Sequence[str]) -> Node:
    members = {key: item for key, item in node.items.items() if key in keys}
    return Node(members, node.place, node.key_place)


def _leaves_of(change: Node) -> str:
    """Return a name for a variant without one: its changes."""
    return ", ".join(_leaves(change.plain())) or "as given"


def _leaves(plain: Any, before: str = "") -> Iterator[str]:
    if isinstance(plain, Mapping) and plain:
        for key, item in plain.items():
            yield from _leaves(item, f"{before}.{key}" if before else key)
    else:
        text = json.dumps(plain) if isinstance(plain, (list, dict, bool)) else plain
        yield f"{before} {text}"


def variants_of(root: Node) -> list[Node]:
    """Return the variants that a document lists; raises `ConfigError`."""
    node = root.get("variants")
    if node is None:
        return []
    if not isinstance(node.value, tuple):
        raise ConfigError(f"{node.place}: variants: a list is required")
    return list(node.value)
