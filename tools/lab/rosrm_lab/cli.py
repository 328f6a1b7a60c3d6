"""`rosrm lab`: virtual hosts on this machine, to try a cluster before the robots do."""

# Each command imports what it needs when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rosrm.cli.options import AsJson
from rosrm.errors import ConfigError, LabError

if TYPE_CHECKING:
    from rosrm_lab import HostPlan, HostStatus, Lab

lab = typer.Typer(
    no_args_is_help=True,
    help="Virtual hosts on this machine, each with its own limits. Needs root.",
)


class Way(str, Enum):
    """A direction, as seen from the host."""

    IN = "in"
    OUT = "out"
    BOTH = "both"


Named = Annotated[
    str,
    typer.Option(
        "--lab", metavar="NAME", envvar="ROSRM_LAB", help="Name of the lab; default: lab."
    ),
]
Host = Annotated[str, typer.Argument(metavar="HOST", help="Name of a host of the lab.")]
Direction = Annotated[
    Way, typer.Option("--direction", help="Packets to the host (in), from the host (out), or both.")
]


@lab.callback()
def _group() -> None:
    """Virtual hosts on this machine, each with its own limits. Needs root."""


@lab.command()
def up(  # noqa: PLR0917 - typer calls it, by name
    number: Annotated[
        int, typer.Option("-n", "--hosts", metavar="N", help="Number of hosts: host1, host2, ...")
    ] = 3,
    memory: Annotated[
        str, typer.Option("--memory", metavar="SIZE", help="Memory of each host; `none`: no limit.")
    ] = "none",
    cpu: Annotated[
        str, typer.Option("--cpu", metavar="CORES", help="Cores of each host; `none`: no limit.")
    ] = "none",
    disk: Annotated[
        str, typer.Option("--disk", metavar="SIZE", help="Disk of each host.")
    ] = "1GiB",
    host: Annotated[
        list[str] | None,
        typer.Option(
            "--host",
            metavar="NAME[:LIMITS]",
            help="Add a host, or change the limits of one: `desk:memory=none,cpu=2,disk=4GiB`. "
            "Limits that are left out are as for the other hosts. May be repeated.",
        ),
    ] = None,
    subnet: Annotated[
        str,
        typer.Option(
            "--subnet", metavar="RANGE", help="Addresses of the hosts; default: a free range."
        ),
    ] = "",
    name: Named = "lab",
) -> None:
    """Make a lab. What a killed attempt left behind is removed first."""
    from rosrm_lab import Lab
    from rosrm_lab.needs import overbooked
    from rosrm_lab.plan import parse_subnet

    limits = {"memory": memory, "cpu": cpu, "disk": disk}
    hosts = planned(number, limits, host or [])
    made = Lab(name, hosts, subnet=parse_subnet(subnet) if subnet else None)
    with _interrupts_deferred() as stop_if_interrupted:
        made.up(between=stop_if_interrupted)
        warning = overbooked(hosts)
        if warning:
            typer.echo(f"rosrm: note: {warning}", err=True)
        addresses = ", ".join(f"{one.name} {made.address(one.name)}" for one in hosts)
        typer.echo(f"lab {name!r} is up: {addresses}")


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C: it takes effect where the caller asks for it, and not at all after the block.

    Otherwise it could come at a fork or in a finaliser. Python ignores it there, and prints a
    traceback.
    """
    interrupts: list[int] = []

    def stop_if_interrupted() -> None:
        if interrupts:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        yield stop_if_interrupted
    except BaseException as error:
        signal.signal(signal.SIGINT, before)
        if isinstance(error, LabError):
            stop_if_interrupted()  # the signal has ended a child of this process
        raise
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@lab.command(
    "exec",
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
)
def execute(
    host: Host,
    command: Annotated[list[str], typer.Argument(metavar="CMD...", help="Program and arguments.")],
    user: Annotated[
        str, typer.Option("-u", "--user", metavar="USER", help="Run as this user, not as root.")
    ] = "",
    variable: Annotated[
        list[str] | None,
        typer.Option("-e", "--env", metavar="NAME=VALUE", help="Set a variable. May be repeated."),
    ] = None,
    name: Named = "lab",
) -> None:
    """Run a command on a host, as if it were typed there.

    Standard input, terminal and signals are the command's; its exit code is ours.
    """
    words = command[1:] if command[0] == "--" else command
    opened(name).become(host, words, user=user, env=dict(map(_variable, variable or [])))


@lab.command()
def cut(host: Host, direction: Direction = Way.BOTH, name: Named = "lab") -> None:
    """Cut a host's network, in one direction or both.

    Cuts add up: after `--direction in` and `--direction out` both are cut. `heal` ends them.
    """
    opened(name).cut(host, direction.value)
    _say_link(name, host)


@lab.command()
def heal(host: Host, name: Named = "lab") -> None:
    """End the cut, the loss, the delay and the rate of a host."""
    opened(name).heal(host)
    _say_link(name, host)


@lab.command()
def loss(
    host: Host,
    share: Annotated[
        str, typer.Argument(metavar="SHARE", help="Share of packets to drop: 1% or 0.01.")
    ],
    direction: Direction = Way.BOTH,
    name: Named = "lab",
) -> None:
    """Drop a share of the packets to and from a host; 0 ends it."""
    opened(name).loss(host, fraction(share), direction.value)
    _say_link(name, host)


@lab.command()
def delay(
    host: Host,
    time: Annotated[
        str, typer.Argument(metavar="TIME", help="Delay of each packet, such as 50ms.")
    ],
    direction: Direction = Way.BOTH,
    name: Named = "lab",
) -> None:
    """Delay packets to and from a host; 0 ends it. Needs a kernel with netem."""
    opened(name).delay(host, _quantity("duration", time, "TIME"), direction.value)
    _say_link(name, host)


@lab.command()
def rate(
    host: Host,
    limit: Annotated[
        str, typer.Argument(metavar="RATE", help="Bytes a second that pass, such as 5MB/s.")
    ],
    direction: Direction = Way.BOTH,
    name: Named = "lab",
) -> None:
    """Drop the packets to and from a host beyond a rate; 0 ends it."""
    opened(name).rate(host, _quantity("rate", limit, "RATE"), direction.value)
    _say_link(name, host)


@lab.command()
def kill(host: Host, name: Named = "lab") -> None:
    """Cut a host's power: all its processes end at once. `boot` switches it on again."""
    opened(name).kill(host)
    typer.echo(f"{host} is off; `rosrm lab boot {host}` switches it on again")


@lab.command()
def boot(host: Host, name: Named = "lab") -> None:
    """Switch a host on again after `kill`.

    Its disk and its network faults (cut, loss, delay, rate) are kept. No process runs on it yet.
    """
    opened(name).boot(host)
    network = _network(name, host)
    still = f"; its network is still: {network}" if network else ""
    typer.echo(f"{host} is up{still}")


@lab.command()
def status(
    as_json: AsJson = False,
    name: Annotated[
        str, typer.Option("--lab", metavar="NAME", help="Show only this lab; default: all labs.")
    ] = "",
) -> None:
    """List the labs and their hosts."""
    from rosrm.cli.output import json_forms, tables
    from rosrm.errors import LabError
    from rosrm_lab import all_labs

    _check_rights()
    rows: list[HostStatus] = []
    for one in [opened(name)] if name else all_labs():
        try:
            rows += one.status()
        except LabError as error:
            if name:
                raise
            typer.echo(f"rosrm: note: {error}", err=True)
    if as_json:
        json_forms.show([asdict(row) for row in rows])
    elif rows:
        tables.show(_table(rows))
    else:
        typer.echo("no lab; `rosrm lab up` makes one")


@lab.command()
def down(
    name: Named = "lab",
    everything: Annotated[
        bool, typer.Option("--all", help="Remove every lab on this machine.")
    ] = False,
) -> None:
    """Remove a lab: its processes end at once, and its disks are deleted."""
    from rosrm_lab import Lab, all_labs

    _check_rights()
    chosen = list(all_labs()) if everything else [Lab(name)]
    removed = [one.name for one in chosen if one.down()]
    if removed:
        typer.echo(f"removed: {', '.join(removed)}")
    else:
        typer.echo("no lab" if everything else f"no lab {name!r}: nothing to remove")


# --- helpers ----------------------------------------------------------------------------------


def opened(name: str) -> Lab:
    """Return the lab that a command works on."""
    from rosrm_lab import Lab

    _check_rights()
    return Lab(name)


def planned(number: int, limits: dict[str, str], more: Sequence[str]) -> list[HostPlan]:
    """Return the hosts that the options of `up` define; raises `ConfigError`.

    Args:
        number: of equal hosts.
        limits: theirs, as text, by resource.
        more: further hosts, or other limits, in the format of `--host`.
    """
    from rosrm_lab.plan import MOST_HOSTS

    if not 0 <= number <= MOST_HOSTS or (number == 0 and not more):
        raise ConfigError(f"-n {number}; allowed are 1 to {MOST_HOSTS} hosts, 0 with --host")
    by_name = {f"host{i}": limits for i in range(1, number + 1)}
    for text in more:
        name, own = _named_limits(text)
        by_name[name] = {**by_name.get(name, limits), **own}
    return [_host(name, one) for name, one in by_name.items()]


def fraction(text: str) -> float:
    """Return the fraction for `1%` or `0.01`; raises `ConfigError`."""
    from rosrm_lab.wires import check_loss

    percent = text.endswith("%")
    try:
        value = float(text[:-1]) / 100.0 if percent else float(text)
    except ValueError:
        raise ConfigError(f"SHARE {text!r}: give percent (1%) or a fraction (0.01)") from None
    if value >= 1.0 and not percent:  # a plain 1 may mean 1% or all
        raise ConfigError(f"SHARE {text!r}: say {text}% or a fraction below 1; 100% is all")
    check_loss(value)
    return value


def _named_limits(text: str) -> tuple[str, dict[str, str]]:
    name, _, rest = text.partition(":")
    pairs = [part.partition("=") for part in rest.split(",") if part]
    strange = [key for key, equals, _ in pairs if not equals or key not in _MEASURES]
    if strange:
        raise ConfigError(
            f"--host {text!r}: {strange[0]!r} is no limit; "
            f"allowed: {', '.join(f'{key}=...' for key in _MEASURES)}"
        )
    return name, {key: value for key, _, value in pairs}


def _host(name: str, limits: dict[str, str]) -> HostPlan:
    from rosrm_lab import HostPlan

    memory = _limit(name, "memory", limits["memory"])
    cpu = _limit(name, "cpu", limits["cpu"])
    disk = _limit(name, "disk", limits["disk"])
    if disk is None:
        raise ConfigError(f"host {name}: a disk has a size; give one, for example 1GiB")
    return HostPlan(name, None if memory is None else int(memory), cpu, int(disk))


#: A limit that is a multiple of this was given in powers of 1024, and is shown so.
_MIB = 2**20
#: The kinds of quantities, by their names in `rosrm.extensions.units`.
_MEASURES = {"memory": "size", "cpu": "cores", "disk": "size"}


def _limit(host: str, what: str, text: str) -> float | None:
    if text == "none":
        return None
    return _quantity(_MEASURES[what], text, f"{what} of {host}")


def _quantity(measures: str, text: str, where: str) -> float:
    """Return a number with or without a unit; a shell passes text in any case."""
    from rosrm.extensions.units import Quantity

    try:
        return Quantity(measures).parse(_number(text))
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _variable(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"--env {text!r}: give NAME=VALUE")
    return name, value


def _check_rights() -> None:
    from rosrm_lab.needs import check_rights

    check_rights()


def _say_link(name: str, host: str) -> None:
    typer.echo(f"{host}: {_network(name, host) or 'its network has no fault'}")


def _network(name: str, host: str) -> str:
    """Return the faults of a host's network as text; "": none."""
    (row,) = [row for row in opened(name).status() if row.name == host]
    return row.network


def _table(rows: Iterable[HostStatus]) -> Any:
    from rich.text import Text

    from rosrm.cli.output import tables

    numbers = ("MEMORY", "CPU", "DISK", "PROCESSES")
    made = tables.table("LAB", "HOST", "STATE", "ADDRESS", *numbers, "NETWORK", right=numbers)
    for row in rows:
        made.add_row(
            Text(row.lab),
            Text(row.name),
            Text(row.state, "green" if row.state == "up" else "red"),
            row.address,
            _used(row.memory_used, row.memory),
            "" if row.cpu is None else f"{row.cpu:g}",
            _used(row.disk_used, row.disk),
            str(row.processes),
            Text(row.network or "ok", "yellow" if row.network else ""),
        )
    return made


def _used(used: int | None, limit: int | None) -> str:
    from rosrm.wording import size

    binary = limit is not None and limit % _MIB == 0
    said = "?" if used is None else size(used, binary=binary)
    return said if limit is None else f"{said}/{size(limit, binary=binary)}"
