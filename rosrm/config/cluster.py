"""Loader of `cluster.yaml`, the settings of a master."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from rosrm.config.checking import near, salvaged
from rosrm.config.documents import Node, Problems, parse, read
from rosrm.config.kinds import check_kind
from rosrm.config.options import PluginCheck
from rosrm.config.rules import check_amounts, check_name, settled
from rosrm.config.settings import ClusterConfig, ScoringChoice
from rosrm.config.work import checked_defaults
from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry
from rosrm.keys.roles import principal_of

#: Sections that `_check_times` reads.
_OF_TIME: Final = ("liveness", "control")
#: Beat periods in `liveness.suspect`; a slave without changes sends one message in each period.
_BEATS: Final = 3
#: Tolerance for floating point: three times 0.2 s is slightly more than 0.6 s.
_ROUNDING: Final = 1e-9


def load_cluster(path: str | Path, registry: Registry | None = None) -> ClusterConfig:
    """Read a master's settings; raises one `ConfigError` with all problems.

    Args:
        path: path of the file.
        registry: the installed plugins; None: names and options of plugins are not checked.
    """
    return checked_cluster(read(path), path, registry)


def default_cluster(registry: Registry | None = None) -> ClusterConfig:
    """Return the settings of a master without a file, with its plugins checked as for a file."""
    return checked_cluster(parse("", "the default settings"), "", registry)


def checked_cluster(root: Node, path: str | Path, registry: Registry | None) -> ClusterConfig:
    """Return a master's settings from a parsed document, with the checks of `load_cluster`."""
    problems = Problems()
    check_kind(root, "cluster")
    config, wrong = salvaged(ClusterConfig, root, problems)
    _check_rules(root, config if wrong.isdisjoint(_OF_TIME) else None, problems)
    plugins = PluginCheck(registry, problems)
    plugins.check_resources(root.get("defaults", "needs"), "defaults.needs")
    config = _with_options(root, config or ClusterConfig(), plugins)
    config = _with_process(root, path, config, plugins, problems)
    problems.raise_any()
    if config.record.directory != Path():
        directory = settled(config.record.directory, path)
        config = replace(config, record=replace(config.record, directory=directory))
    return replace(config, state=settled(config.state, path))


def _check_rules(root: Node, config: ClusterConfig | None, problems: Problems) -> None:
    check_name(root.get("name"), "cluster", problems)
    check_amounts(root.get("defaults", "needs"), "defaults.needs", problems)
    _check_users(root.get("quotas"), problems)
    _check_chain(root.get("scoring"), problems)
    if config is not None:
        _check_times(root, config, problems)
    options = root.get("checkpoint", "options")
    named = root.get("checkpoint", "policy")
    if options is not None and options.items and named is not None and named.value is None:
        problems.add(
            options.place, "checkpoint.options: options of no policy; name one in `policy`"
        )


def _check_users(quotas: Node | None, problems: Problems) -> None:
    """Add a problem for each quota whose key is no name of a user."""
    for name, quota in (quotas.items if quotas else {}).items():
        try:
            principal_of(f"user:{name}")
        except ConfigError:
            fault = f"quotas: {name!r} is no name of a user; for user:ada write ada"
            problems.add(quota.key_place or quota.place, fault)


def _check_times(root: Node, config: ClusterConfig, problems: Problems) -> None:
    suspect, lease = config.liveness.suspect, config.liveness.lease
    if suspect >= lease:
        problems.add(
            root.deepest(("liveness", "suspect")).place,
            f"liveness.suspect ({suspect:g} s) must be less than liveness.lease ({lease:g} s)",
        )
    period = config.control.beat_period
    if suspect >= _BEATS * period - _ROUNDING:
        return
    keys = ("control", "beat_period")
    given = keys if root.get(*keys) is not None else ("liveness", "suspect")
    problems.add(
        root.deepest(given).place,
        f"control.beat_period ({period:g} s) must be at most a third of liveness.suspect "
        f"({suspect:g} s): a slave without changes reports once in a beat period",
    )


def _with_options(root: Node, config: ClusterConfig, plugins: PluginCheck) -> ClusterConfig:
    """Return the settings with checked options of plugins, including plugins chosen by default."""
    named = root.get("migration", "strategies")
    if named is None:
        # Use the installed default strategies; if there is none, report the first as missing.
        default = list(config.migration.strategies)
        there = [name for name in default if plugins.has("migration", name)]
        strategies = {
            name: plugins.choice("migration", name, root, None) for name in there or default[:1]
        }
    else:
        strategies = plugins.by_name("migration", named)
    return replace(
        config,
        scoring=_scoring(root, config, plugins),
        filters=plugins.by_name("filter", root.get("filters")),
        checkpoint=replace(config.checkpoint, options=_checkpoint(root, config, plugins)),
        migration=replace(config.migration, strategies=strategies),
    )


def _with_process(
    root: Node, path: str | Path, config: ClusterConfig, plugins: PluginCheck, problems: Problems
) -> ClusterConfig:
    """Return the settings with the checked defaults of what a process leaves out."""
    given = root.get("defaults", "process")
    process = checked_defaults(given, path, plugins, problems)
    if given is None or process is None:
        return config
    strategy = process.migration.strategy
    if strategy is not None and strategy not in config.migration.strategies:
        selected = list(config.migration.strategies)
        text = f"migration strategy {strategy!r} is not selected{near(strategy, selected)}"
        problems.add(given.deepest(("migration", "strategy")).place, f"defaults.process: {text}")
    return replace(config, defaults=replace(config.defaults, process=process))


def _scoring(root: Node, config: ClusterConfig, plugins: PluginCheck) -> tuple[ScoringChoice, ...]:
    """Return the chain of scoring policies with checked options."""
    section = root.get("scoring") or Node({}, root.place)
    links = section.value if isinstance(section.value, tuple) else (section,)
    known = config.scoring if len(config.scoring) == len(links) else (ScoringChoice(),) * len(links)
    return tuple(_link(*pair, plugins) for pair in zip(links, known, strict=True))


def _link(node: Node, choice: ScoringChoice, plugins: PluginCheck) -> ScoringChoice:
    name = _policy_in(node) or choice.policy
    options = plugins.choice("scoring", name, node.get("policy") or node, node.get("options"))
    return replace(choice, options=options)


def _check_chain(section: Node | None, problems: Problems) -> None:
    """Add a problem for an empty chain of scoring policies, and for each repeated policy."""
    if section is None or not isinstance(section.value, tuple):
        return
    if not section.value:
        problems.add(section.place, "scoring: at least one policy is required; or omit the key")
    names = [_policy_in(link) or ScoringChoice().policy for link in section.value]
    for at, link in enumerate(section.value):
        if names[at] in names[:at]:
            place = (link.get("policy") or link).place
            text = f"scoring: {names[at]!r} is in the chain already; give it once, with one weight"
            problems.add(place, text)


def _checkpoint(root: Node, config: ClusterConfig, plugins: PluginCheck) -> Mapping[str, Any]:
    """Return the checked options of the checkpoint policy.

    The default one may be missing if the file gives neither its name nor options.
    """
    policy, options = config.checkpoint.policy, root.get("checkpoint", "options")
    named = root.get("checkpoint", "policy")
    is_given = named is not None or (options is not None and bool(options.items))
    if policy is None or not (is_given or plugins.has("checkpoint", policy)):
        return {}
    return plugins.choice("checkpoint", policy, named or root.get("checkpoint") or root, options)


def _policy_in(link: Node) -> str | None:
    node = link.get("policy")
    return node.value if node is not None and isinstance(node.value, str) else None
