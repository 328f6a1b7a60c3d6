"""Groups of commands: help, usage lines, and hints for an unknown verb."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, Final, cast

from typer import BadParameter, Typer
from typer.core import TyperCommand, TyperGroup

from rosrm.wording import get_close_matches, listed

#: Verbs of other tools, and the equivalent commands of rosrm.
_ELSEWHERE: Final = {
    word: verbs
    for verbs, words in (
        (("cancel", "restart"), "stop"),
        (("cancel",), "kill delete del remove rm abort terminate down destroy"),
        (("submit",), "add create deploy queue enqueue"),
        (("submit", "restart"), "start"),
        (("restart",), "reload"),
        (("ps",), "list ls processes jobs services get"),
        (("hosts",), "nodes node host machines agents slaves members"),
        (("migrate",), "move mv"),
        (("explain",), "why describe inspect show"),
        (("events",), "journal"),
        (("logs",), "log tail output"),
        (("status",), "info cluster"),
        (("config check",), "check validate lint"),
        (("master", "slave"), "server agent daemon serve"),
    )
    for word in words.split()
}
#: Command to the distribution that has it.
DISTRIBUTIONS: Final = {
    "alerts": "rosrm-alerts", "criu": "rosrm-criu", "lab": "rosrm-lab", "launch": "rosrm-launch",
    "metrics": "rosrm-web", "report": "rosrm-report", "simulate": "rosrm-simulate",
    "web": "rosrm-web",
}  # fmt: skip
#: Width in which no summary of a command is cut.
_UNCUT: Final = 1000
#: Duplicate marks of repetition, as in "WORK......" and "[NAME...]...".
_DOTS_TWICE: Final = re.compile(r"(\.\.\.\]?)\.\.\.")
#: Base classes of all errors of a command line, which typer does not export.
_UsageError: Final = cast(type[Any], BadParameter.__mro__[1])
CommandLineError: Final = cast(type[Exception], BadParameter.__mro__[2])
_BRACES: Final = str.maketrans("", "", "{}")


class PlainCommand(TyperCommand):
    """Command with plain usage lines (`WORK...`, `[NAME...]`) and plain errors."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; raise errors with rosrm's wording instead of the library's."""
        try:
            return super().parse_args(ctx, args)
        except BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise
        except _UsageError as error:
            if "extra argument" in error.message and any(one.name == "to" for one in self.params):
                error.message += ". The destination is an option: --to HOST"
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line."""
        pieces = super().collect_usage_pieces(ctx)
        return [_DOTS_TWICE.sub(r"\1", piece.translate(_BRACES)) for piece in pieces]


class PlainGroup(TyperGroup):
    """Group of commands with uncut summaries in its help."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        found = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        shown = [(name, one) for name, one in found if one is not None and not one.hidden]
        with formatter.section("Commands"):
            formatter.write_dl([(name, one.get_short_help_str(_UNCUT)) for name, one in shown])


def add_command(app: Typer, name: str, command: object) -> None:
    """Add a command, or a group of commands (`typer.Typer`), with plain help and errors.

    Raises:
        TypeError: the object is neither a function nor a `typer.Typer`.
    """
    if isinstance(command, Typer):
        for one in command.registered_commands:
            one.cls = PlainCommand
        app.add_typer(command, name=name, cls=PlainGroup)
    elif callable(command):
        app.command(name, cls=PlainCommand)(command)
    else:
        raise TypeError(f"{command!r} is neither a function nor a typer.Typer")


def hint_after(word: str, known: Iterable[str]) -> str:
    """Return a question with the commands nearest to an unknown one; "" for none.

    Args:
        word: a verb of another tool, or a misspelt command.
        known: the names of all commands.
    """
    meant = _ELSEWHERE.get(word.lower()) or get_close_matches(word, known)
    return f"Did you mean {listed([repr(one) for one in meant], 'or')}?" if meant else ""
