"""Loader of `host.yaml`, the settings of a slave."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rosrm.config.checking import validated
from rosrm.config.documents import Node, Problems, read
from rosrm.config.first_name import first_name
from rosrm.config.kinds import check_kind
from rosrm.config.options import PluginCheck
from rosrm.config.rules import check_amounts, check_name, settled
from rosrm.config.settings import HostConfig
from rosrm.extensions.registry import Registry
from rosrm.model.devices import device_fault

#: Resources whose budget is required for the scope "slice".
_OF_A_SLICE = ("memory", "cpu")


def load_host(path: str | Path, registry: Registry | None = None) -> HostConfig:
    """Read a slave's settings; raises one `ConfigError` with all problems.

    Args:
        path: path of the file.
        registry: the installed plugins; None: names and options of plugins are not checked.
    """
    return checked_host(read(path), path, registry)


def checked_host(root: Node, path: str | Path, registry: Registry | None) -> HostConfig:
    """Return a slave's settings from a parsed document; otherwise as `load_host`."""
    problems = Problems()
    check_kind(root, "host")
    config = validated(HostConfig, root, problems)
    _check_rules(root, problems)
    for kind, units in config.devices.items() if config is not None else ():
        fault = device_fault(units)
        if fault:
            problems.add(root.deepest(("devices", kind)).place, f"devices: {fault}")
    chosen = root.get("probes")
    plugins = PluginCheck(registry, problems)
    probes = plugins.by_name("probe", chosen)
    given = chosen is not None and chosen.value is not None
    strategies = plugins.by_name("migration", root.get("strategies"), part="host_options")
    if registry is not None:
        measured = probes if given else registry.default_probes()
        for key in ("limits", "budget"):
            plugins.check_resources(root.get(key), key, measured)
    problems.raise_any()
    assert config is not None  # else there was a problem
    state = settled(config.state, path)
    is_named, has_state = (root.get(key) is not None for key in ("host", "state"))
    host = first_name(state) if has_state and not is_named else config.host
    return replace(
        config, host=host, state=state, probes=probes if given else None,
        textfile=config.textfile if config.textfile == Path() else settled(config.textfile, path),
        strategies=strategies,
    )  # fmt: skip


def _check_rules(root: Node, problems: Problems) -> None:
    check_name(root.get("host"), "host", problems)
    check_amounts(root.get("budget"), "budget", problems, above=True)
    scope, budget = root.get("scope"), root.get("budget")
    if scope is None or scope.value != "slice":
        return
    missing = [name for name in _OF_A_SLICE if budget is None or budget.child(name) is None]
    if missing:
        problems.add(
            (budget or scope).place,
            f"scope: a slice needs its budget of {' and '.join(missing)}, "
            "for example `budget: {memory: 2GiB, cpu: 1.0}`",
        )
