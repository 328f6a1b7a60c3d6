"""Event sink that starts a command for each notice."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass

from rosrm import Notice, PositiveSeconds, RosrmError, SkipPlugin
from rosrm.wording import ending_of


@dataclass(frozen=True)
class CommandOptions:
    """Options of the sink.

    Attributes:
        command: program with its arguments; `{message}`, `{kind}`, `{level}`, `{process}`, `{host}`
            and `{alert}` in an argument are replaced.
        timeout: seconds after which the command is killed.
    """

    command: tuple[str, ...] = ()
    timeout: PositiveSeconds = 30.0

    def __post_init__(self) -> None:
        """Refuse an empty command; raises `ValueError`."""
        if not self.command:
            raise ValueError("command: a list is required, such as [notify-send, '{message}']")


class Command:
    """Starts a command; the notice is on its standard input, as JSON.

    No shell is involved, so that text in a notice cannot become a command.
    """

    def __init__(self, options: CommandOptions) -> None:
        self._options = options
        if shutil.which(options.command[0]) is None:
            raise SkipPlugin(f"there is no program {options.command[0]!r}")

    def send(self, notices: Sequence[Notice]) -> None:
        """Start the command for each notice; an exit code other than 0 is a failure."""
        for notice in notices:
            self._run(notice)

    def _run(self, notice: Notice) -> None:
        fields = notice.form()
        program, *arguments = self._options.command
        argv = [program, *(_filled(argument, fields) for argument in arguments)]
        try:
            done = subprocess.run(
                argv, input=json.dumps(fields), text=True, capture_output=True, check=False,
                timeout=self._options.timeout, errors="replace",
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise RosrmError(f"{program} has not ended after {self._options.timeout:g} s") from None
        except OSError as fault:
            raise RosrmError(f"{program} cannot be started: {fault}") from None
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1:]
            raise RosrmError(": ".join([f"{program}: {ending_of(done.returncode)}", *last]))

    def close(self) -> None:
        """Do nothing; no command outlives `send`."""


def _filled(argument: str, fields: dict[str, object]) -> str:
    """Return an argument with the values of a notice; other braces stay."""
    for name in ("message", "kind", "level", "process", "host", "alert"):
        argument = argument.replace(f"{{{name}}}", str(fields[name]))
    return argument
