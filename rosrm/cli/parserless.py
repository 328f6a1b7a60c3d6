"""Commands whose command line is only their name, or their name with --json: no parser is needed.

The parser (typer) imports pydantic and builds the types of all parameters: a quarter of the CPU
time of such a command.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

#: Functions of `rosrm.cli.commands.inspect`.
COMMANDS: Final = ("hosts", "plugins", "ps", "status")
#: Context of a command without the options that come before its name.
_CONTEXT: Final[Any] = SimpleNamespace(obj=None)


def command(arguments: Sequence[str]) -> Callable[[], None] | None:
    """Return the command of a line that needs no parser; None: the parser must read the line."""
    name, *options = arguments or ("",)
    if name not in COMMANDS or options not in ([], ["--json"]):
        return None
    from rosrm.cli.commands import inspect  # noqa: PLC0415 - after the participant

    return partial(getattr(inspect, name), _CONTEXT, as_json=bool(options))
