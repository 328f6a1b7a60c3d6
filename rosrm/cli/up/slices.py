"""Hosts of `rosrm up`: slices of this machine, each with a share of its resources."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

from rosrm.cli.options import pairs_of
from rosrm.config.checking import near
from rosrm.config.settings import HostConfig
from rosrm.errors import ConfigError, PluginError
from rosrm.extensions.contracts import ProbeContext
from rosrm.extensions.guard import guarded
from rosrm.extensions.made import close_quietly
from rosrm.extensions.plugin_calls import titled
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import amount_of
from rosrm.slave.probe_reads import read_values
from rosrm.slave.sessions import SessionTable

#: Resources of a slice, and True where other programs keep what they use now. A CPU is different:
#: their usage changes all the time.
_DIVIDED: Final[Mapping[str, bool]] = {"memory": True, "cpu": False, "disk": True}
#: Label with the name of the host, so that a process can require one host.
_LABEL: Final = "host"
#: Least seconds for the first read of a probe.
_READ: Final = 5.0


def slices(
    count: int, budget: Mapping[str, float], registry: Registry, directory: Path
) -> list[HostConfig]:
    """Return the hosts `host-1`, `host-2` and so on.

    Each host measures its own processes against its share of the resources that are free now. The
    other resources, such as GPUs, belong to the first host alone.

    Args:
        count: number of hosts.
        budget: amounts of each host, in base units by resource, instead of its share.
        registry: the installed plugins, which measure this machine.
        directory: existing directory on the disk to be divided.
    """
    lost = [f"{one.source}: {one.reason}" for one in registry.lost_probes().values()]
    if lost:
        raise ConfigError(f"this machine cannot be measured, so not divided: {'; '.join(lost)}")
    probes = registry.default_probes()
    divided = {name: options for name, options in probes.items() if name in _DIVIDED}
    shares = {name: free / count for name, free in _free(divided, registry, directory).items()}
    return [
        HostConfig(
            host=f"host-{number}", scope="slice", budget={**shares, **budget},
            labels={_LABEL: f"host-{number}"}, probes=None if number == 1 else divided,
        )
        for number in range(1, count + 1)
    ]  # fmt: skip


def budget_of(words: list[str]) -> dict[str, float]:
    """Return the amounts of `--budget RESOURCE=AMOUNT` by resource; raises `ConfigError`."""
    budget = {}
    for resource, text in pairs_of("--budget", words, "RESOURCE=AMOUNT").items():
        if resource not in _DIVIDED:
            raise ConfigError(
                f"--budget {resource}={text}: unknown resource {resource!r}"
                f"{near(resource, _DIVIDED)}"
            )
        try:
            budget[resource] = amount_of(resource, text)
        except ValueError as error:
            raise ConfigError(f"--budget {resource}: {error}") from None
        if budget[resource] <= 0.0:
            raise ConfigError(f"--budget {resource}={text}: must be above 0")
    return budget


def _free(
    probes: Mapping[str, Mapping[str, object]], registry: Registry, directory: Path
) -> dict[str, float]:
    """Return the free amounts of the divided resources on this machine, in base units.

    Where this process's control group may use less than the machine, the group counts.
    """
    context = ProbeContext("cgroup", {}, directory, SessionTable())
    free = {}
    for one in registry.probes(probes, context).made:
        try:
            capacity = {resource.name: resource.capacity for resource in one.resources}
            used = guarded(
                partial(read_values, one.probe, tuple(capacity)),
                whom=titled("probe", one.name), hook="read", seconds=max(one.deadline, _READ),
            )  # fmt: skip
            for name, usage in zip(capacity, used, strict=True):
                kept = usage if _DIVIDED.get(name) else 0.0
                free[name] = capacity[name] * (1.0 - kept)
        except PluginError:
            if _DIVIDED.keys() & {resource.name for resource in one.resources}:
                raise
        finally:
            close_quietly(one.probe)
    return {name: amount for name, amount in free.items() if name in _DIVIDED}
