"""Options shared by several commands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from rosrm.cli import completion
from rosrm.errors import ConfigError
from rosrm.extensions.units import Quantity
from rosrm.model.ros_settings import HIGHEST_DOMAIN


@dataclass(frozen=True)
class CommonOptions:
    """Options given before the command's name."""

    domain: int | None = None
    cluster: Path | None = None


Domain = Annotated[
    int | None,
    typer.Option(
        "--domain",
        metavar="N",
        min=0,
        max=HIGHEST_DOMAIN,
        help="ROS domain, e.g. 42, instead of ROS_DOMAIN_ID.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Name = Annotated[
    str,
    typer.Argument(metavar="NAME", help="Name of a process.", autocompletion=completion.processes),
]
_NAMES: Final = typer.Argument(
    metavar="NAME...", help="Names of processes.", autocompletion=completion.processes
)
Names = Annotated[list[str], _NAMES]
SomeNames = Annotated[list[str] | None, _NAMES]
Array = Annotated[
    str, typer.Option("--array", metavar="NAME", help="Only jobs of this array, e.g. render.")
]
Application = Annotated[
    str,
    typer.Option(
        "--app",
        metavar="APP",
        help="Only processes of this application.",
        autocompletion=completion.applications,
    ),
]
Host = Annotated[
    str,
    typer.Argument(metavar="HOST", help="Name of a host.", autocompletion=completion.hosts),
]


def host_option(effect: str) -> Any:
    """Return the option --host of a command that it narrows; the effect is its help."""
    return typer.Option("--host", metavar="HOST", help=effect, autocompletion=completion.hosts)


def seconds_of(
    option: str, text: str, *, low: float = 0.0, above: bool = True, hint: str = ""
) -> float:
    """Return the time span of an option in seconds; raises `ConfigError`, with the hint."""
    try:
        return Quantity("duration", low=low, above=above).parse(text)
    except ValueError as error:
        raise ConfigError(f"{option}: {error}{hint}") from None


def size_of(option: str, text: str, *, low: int) -> int:
    """Return the size of an option in bytes; raises `ConfigError`."""
    try:
        return int(Quantity("size", low=low, whole=True).parse(text))
    except ValueError as error:
        raise ConfigError(f"{option}: {error}. Give a size, e.g. 20GB") from None


def pairs_of(option: str, words: Iterable[str], form: str) -> dict[str, str]:
    """Return the values of a repeated option by their names; the last of a name counts.

    Args:
        option: name of the option, for messages.
        words: "NAME=VALUE" each.
        form: form of a word, for messages.

    Raises:
        ConfigError: a word has another form.
    """
    pairs = {}
    for word in words:
        name, mark, value = word.partition("=")
        if not (name and mark):
            raise ConfigError(f"{option} {word}: give {form}")
        pairs[name] = value
    return pairs
