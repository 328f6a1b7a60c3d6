"""Command `rosrm config check`: validation of configuration files before use."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rosrm.cli.groups import DISTRIBUTIONS
from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError, PluginError
from rosrm.extensions.guard import guarded
from rosrm.wording import counted, get_close_matches, listed

if TYPE_CHECKING:
    from rosrm.config.documents import Node
    from rosrm.config.settings import ClusterConfig, HostConfig
    from rosrm.extensions.registry import Registry
    from rosrm.model.values import ProcessSpec

#: Lowest similarity of a misspelt word; `gpu_memory` and `memory` are less similar.
_NEAR: Final = 0.8

config = typer.Typer(no_args_is_help=True, help="Check configuration files.")


class KindOfFile(str, Enum):
    """Kinds of configuration files."""

    CLUSTER = "cluster"
    HOST = "host"
    WORK = "work"
    MODES = "modes"
    SIMULATION = "simulation"


@config.callback()
def _group() -> None:
    """Check configuration files."""


@config.command()
def check(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="cluster.yaml, host.yaml, work.yaml, modes.yaml or a simulation's workload.",
        ),
    ],
    kind: Annotated[
        KindOfFile | None,
        typer.Option("--kind", help="Kind of the files; default: found by their keys or names."),
    ] = None,
) -> None:
    """Check configuration files without starting anything.

    The files are checked against all rules and against the plugins installed on this machine.
    """
    from rosrm.extensions.registry import Registry

    registry = Registry.discover()
    wrong = []
    for file in files:
        try:
            echo(f"{file}: ok, {_checked(file, kind, registry)}")
        except ConfigError as error:
            wrong.append(str(error))
    if wrong:
        raise ConfigError("\n".join(wrong))


def _make(file: Path, cluster: ClusterConfig, registry: Registry) -> None:
    """Create the plugins that a master would create; raises `ConfigError` with all failures."""
    wrong, checkpoint = [], _checkpoint_of(cluster, registry)
    plugins: list[tuple[str, Callable[[], object]]] = [
        *(("scoring", partial(registry.scoring, o.policy, o.options)) for o in cluster.scoring),
        *(("filters", partial(registry.filters, {n: o})) for n, o in cluster.filters.items()),
        *(
            ("migration", partial(registry.migrations, {name: options}))
            for name, options in cluster.migration.strategies.items()
        ),
        ("checkpoint", partial(registry.checkpoint, checkpoint, cluster.checkpoint.options)),
    ]
    for section, make in plugins:
        try:
            make()
        except (ConfigError, PluginError) as error:
            wrong.append(f"{file}: {section}: {error}")
    if wrong:
        raise ConfigError("\n".join(wrong))


def _checkpoint_of(cluster: ClusterConfig, registry: Registry) -> str | None:
    """Return the checkpoint policy; None: there is none, or the default one is not installed."""
    policy = cluster.checkpoint.policy
    return policy if policy in registry.names("checkpoint") else None


def _make_probes(file: Path, host: HostConfig, registry: Registry) -> None:
    """Create the probes that a slave would create; raises `ConfigError` with all failures.

    A probe that reports itself absent is no failure, because the file may be for another host.
    """
    from rosrm.extensions.contracts import ProbeContext
    from rosrm.extensions.made import FailedProbe, close_quietly
    from rosrm.slave.sessions import SessionTable

    context = ProbeContext(host.scope, host.budget, host.state, SessionTable())
    made = registry.probes(host.probes, context).made
    wrong = [
        f"{file}: probes: {one.name}: {one.probe.reason}"
        for one in made
        if isinstance(one.probe, FailedProbe)
    ]
    for one in made:
        close_quietly(one.probe)
    if wrong:
        raise ConfigError("\n".join(wrong))


def _checked(file: Path, kind: KindOfFile | None, registry: Registry) -> str:
    """Return a summary of a file; raises `ConfigError`."""
    from rosrm.config.cluster import checked_cluster
    from rosrm.config.documents import read
    from rosrm.config.host import checked_host
    from rosrm.config.kinds import kind_of
    from rosrm.config.misplaced_files import misplaced_files
    from rosrm.config.modes import checked_modes
    from rosrm.config.work import checked_work
    from rosrm.core.master.graph_names import node_of, shared_nodes

    root = read(file)
    match kind.value if kind else kind_of(root):
        case "cluster":
            cluster = checked_cluster(root, file, registry)
            _make(file, cluster, registry)
            strategies = ", ".join(cluster.migration.strategies) or "none"
            filters = "".join(f"filter {name}, " for name in cluster.filters)
            return (
                f"a cluster: scoring {cluster.chain}, {filters}migration {strategies}, "
                f"checkpoint {_checkpoint_of(cluster, registry) or 'none'}"
            )
        case "host":
            host = checked_host(root, file, registry)
            _make_probes(file, host, registry)
            probes = ", ".join(registry.default_probes() if host.probes is None else host.probes)
            return f"a host: {host.host}, probes {probes or 'none'}"
        case "modes":
            modes = checked_modes(root, file, registry)
            return f"{counted(len(modes), 'mode')}: {listed(mode.name for mode in modes)}"
        case "simulation":
            return _check_of_simulations(file)(file, registry)
        case _:
            for warning in _misspelt_needs(root, registry):  # also for a wrong file
                echo(warning, err=True)
            target = checked_work(root, file, registry)
            specs = target.specs
            shared = shared_nodes((spec.name, node_of(spec)) for spec in specs)
            astray = misplaced_files(specs, file)
            for warning in (*shared, *_unknown_dependencies(specs), *astray):
                echo(f"{file}: warning: {warning}", err=True)
            jobs = sum(spec.kind.value == "job" for spec in specs)
            numbers = ((jobs, "job"), (len(specs) - jobs, "service"))
            parts = [counted(number, noun) for number, noun in numbers if number]
            title = f"the application {target.application}" if target.application else "work"
            return f"{title}: {listed(parts) if parts else 'no processes'}"


def _unknown_dependencies(specs: Sequence[ProcessSpec]) -> Iterator[str]:
    """Yield warnings about processes in `after` that are not in the file.

    These are only warnings, because the master may know them.
    """
    known = {spec.name for spec in specs}
    for spec in specs:
        for name in spec.start_order.after.keys() - known:
            near = get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            yield (
                f"{spec.name}: after: no process {name!r} in this file{hint} The master refuses "
                f"the file, unless it has such a process"
            )


def _check_of_simulations(file: Path) -> Callable[[Path, Registry], str]:
    """Return the check of simulation files from the simulator's distribution.

    Raises:
        ConfigError: the distribution is not installed.
        PluginError: the check cannot be imported.
    """
    from pkgutil import resolve_name

    from rosrm.extensions.installed import CHECKS, installed_plugins

    for address in installed_plugins(CHECKS):
        if address.name == "simulation":
            load: Callable[[], Callable[[Path, Registry], str]] = partial(
                resolve_name, address.target
            )
            whom = f"the check of simulation files of {address.distribution}"
            try:
                return guarded(load, whom=whom, hook="import")
            except PluginError as fault:
                raise PluginError(f"{whom} cannot be loaded: {fault}") from None
    needed = DISTRIBUTIONS["simulate"]
    raise ConfigError(f"{file}: the check of a simulation file comes with `pip install {needed}`")


def _misspelt_needs(root: Node, registry: Registry) -> Iterator[str]:
    """Yield warnings about resources in `needs` that may be misspelt names of known resources.

    These are only warnings, because another host may have a probe that this machine lacks.
    """
    read = registry.resources()
    listed_there = root.get("processes")
    entries = listed_there.value if listed_there and isinstance(listed_there.value, tuple) else ()
    for needs in [one.get("needs") for one in (root.child("defaults"), *entries) if one]:
        for name, amount in needs.items.items() if needs else ():
            near = get_close_matches(name, read, n=1, cutoff=_NEAR)
            if near and name not in read:
                place = amount.key_place or amount.place
                hint = f"no probe reads {name!r}; did you mean {near[0]!r}?"
                yield f"{place}: warning: needs: {hint}"
