"""Groups of commands: their help, their usage lines, and hints after an unknown verb."""

from __future__ import annotations

import re
from typing import Any, Final

from typer import BadParameter
from typer.core import TyperCommand, TyperGroup

from rosrm.wording import listed

#: Verbs of other tools, and the commands of rosrm that do as much.
_ELSEWHERE: Final = {
    word: verbs
    for verbs, words in (
        (("cancel", "restart"), "stop"),
        (("cancel",), "kill delete del remove rm abort terminate down destroy"),
        (("submit",), "run launch add create apply up deploy queue enqueue"),
        (("submit", "restart"), "start"),
        (("restart",), "reload"),
        (("ps",), "list ls processes jobs services get"),
        (("hosts",), "nodes node host machines agents slaves members"),
        (("migrate",), "move mv"),
        (("explain",), "why describe inspect show"),
        (("events",), "history journal"),
        (("logs",), "log tail output"),
        (("status",), "info cluster"),
        (("config check",), "check validate lint"),
        (("master", "slave"), "server agent daemon serve"),
    )
    for word in words.split()
}
#: Wide enough that no summary of a command is cut.
_UNCUT: Final = 1000
#: "WORK......" and "[NAME...]..." say twice that a word may be repeated.
_DOTS_TWICE: Final = re.compile(r"(\.\.\.\]?)\.\.\.")
_BRACES: Final = str.maketrans("", "", "{}")


class PlainCommand(TyperCommand):
    """A command with plain usage lines (`WORK...`, `[NAME...]`) and plain errors."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; raise errors without the words of the library that found them."""
        try:
            return super().parse_args(ctx, args)
        except BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line."""
        pieces = super().collect_usage_pieces(ctx)
        return [_DOTS_TWICE.sub(r"\1", piece.translate(_BRACES)) for piece in pieces]


class PlainGroup(TyperGroup):
    """A group whose help prints the whole summary of each command."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - as click calls it
        """Write the list of commands."""
        shown = [(name, one) for name, one in self.commands.items() if not one.hidden]
        with formatter.section("Commands"):
            formatter.write_dl([(name, one.get_short_help_str(_UNCUT)) for name, one in shown])


def hint_after(word: str) -> str:
    """Return the commands meant by a verb of another tool, as a question; "" for none."""
    verbs = _ELSEWHERE.get(word.lower(), ())
    return f"Did you mean {listed([repr(verb) for verb in verbs], 'or')}?" if verbs else ""
