"""State of a visit: the place in the launch files, and all that was found so far."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from launch import LaunchContext
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from rosrm_launch.model import Argument, Load, Omission, Process, Transition, Wait


@dataclass(frozen=True)
class Trigger:
    """Events and delay after which the visited actions happen."""

    waits: tuple[Wait, ...] = ()
    delay: float = 0.0


@dataclass(frozen=True)
class Deferred:
    """Actions that are visited once the rest of the file was.

    Attributes:
        trigger: returns their trigger; None: its process is not known yet.
        variables: local variables of launch at their place.
    """

    entities: Sequence[Any]
    trigger: Callable[[], Trigger | None]
    file: str
    variables: Mapping[str, Any]


class Visit:
    """One visit of a launch file.

    Attributes:
        file, trigger: of the action that is visited.
        before: environment before the visit.
        set_variables: variables of the environment that the file sets, also to the same value;
            `outer_variables`: those of the groups around.
        asked: names of the launch configurations that were asked for.
        numbers: of the processes, by their actions.
    """

    def __init__(self, file: str, arguments: Mapping[str, str]) -> None:
        self.root = self.file = str(Path(file).absolute())
        self.given = dict(arguments)
        self.trigger = Trigger()
        self.before = dict(os.environ)
        self.context = LaunchContext(
            argv=[f"{name}:={value}" for name, value in arguments.items()], noninteractive=True
        )
        self.context._set_asyncio_loop(asyncio.new_event_loop())  # noqa: SLF001 - as its service
        self.set_variables: set[str] = set()
        self.outer_variables: list[set[str]] = []
        self.asked: set[str] = set()
        self.deferred: deque[Deferred] = deque()
        self.arguments: dict[str, Argument] = {}
        self.processes: list[Process] = []
        self.numbers: dict[Any, int] = {}
        self.lifecycle_nodes: list[Any] = []
        self.loads: list[Load] = []
        self.transitions: list[Transition] = []
        self.omissions: list[Omission] = []
        self.notes: dict[str, None] = {}

    def text(self, given: Any) -> str:
        """Return text with its substitutions performed; "" for None."""
        if given is None:
            return ""
        parts = normalize_to_list_of_substitutions(given)
        return str(perform_substitutions(self.context, parts))

    def omit(self, action: Any, reason: str, title: str = "") -> None:
        """List an action that has no counterpart, by default with the name of its class."""
        title = title or type(action).__name__
        self.omissions.append(Omission(file=self.file, action=title, reason=reason))

    def note(self, fact: str) -> None:
        """Note a fact that a user should know, once for each file."""
        self.notes[f"{self.file}: {fact}"] = None

    def defer(self, entities: Sequence[Any], trigger: Callable[[], Trigger | None]) -> None:
        """Let actions be visited later, with the local variables of this place as in launch."""
        variables = dict(self.context.get_locals_as_dict())
        self.deferred.append(Deferred(entities, trigger, self.file, variables))


def program_of(action: Any) -> str:
    """Return the name of a prepared process, to which launch adds a number."""
    return str(action.process_description.final_name.rpartition("-")[0])


def hidden(action: Any, of: type, name: str, default: Any = None) -> Any:
    """Return an attribute that a class of launch does not publish."""
    return getattr(action, f"_{of.__name__}__{name}", default)
