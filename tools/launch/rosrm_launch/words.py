"""The words of a prepared action, read back: ROS arguments, parameters, and paths."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

import yaml

from rosrm.config.parameter_files import parse_parameters
from rosrm.model.values import ALL_NODES
from rosrm_launch.model import Parameters, Process

#: Directories of the operating system, which every host has.
_SYSTEM: Final = ("/bin", "/dev", "/lib", "/proc", "/sbin", "/sys", "/usr")
_LONGEST_PATH: Final = 4096


class RosArguments:
    """The arguments that launch_ros appends for a node, read back in their order."""

    def __init__(self, words: Sequence[str]) -> None:
        self.names: dict[str, str] = {}
        self.remappings: list[tuple[str, str]] = []
        self.parameters: list[Parameters] = []
        self.others: list[str] = []
        left = deque(words)
        while left:
            word = left.popleft()
            if word == "-r":
                source, _, target = left.popleft().partition(":=")
                if source in ("__node", "__ns"):
                    self.names[source] = target
                else:
                    self.remappings.append((source, target))
            elif word == "-p":
                name, _, text = left.popleft().partition(":=")
                node, _, name = name.rpartition(":")
                nodes = f"/{node.strip('/')}" if node else ALL_NODES
                self.parameters.append(Parameters(nodes=nodes, values={name: yaml.safe_load(text)}))
            elif word == "--params-file":
                self.parameters += sections_in(Path(left.popleft()))
            else:
                self.others.append(word)
        if self.others:
            self.others.insert(0, "--ros-args")


def sections_in(path: Path) -> tuple[Parameters, ...]:
    """Return the sections of a parameters file; raises `ValueError` if it is none."""
    try:
        return _sections(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"parameters file {path}: {error}") from None


@cache
def _sections(text: str) -> tuple[Parameters, ...]:
    """Return the sections of a parameters file, which many nodes may share."""
    sections = parse_parameters(text)
    return tuple(Parameters(nodes=one.nodes, values=dict(one.parameters)) for one in sections)


def existing_paths(process: Process) -> list[str]:
    """Return the absolute paths in the texts of a process that exist on this machine."""
    texts = [*process.command, *process.arguments, process.working_directory]
    texts += process.environment.values()
    for one in process.parameters:
        for value in one.values.values():
            texts += [str(part) for part in (value if isinstance(value, list) else [value])]
    texts += [text.rpartition("=")[2] for text in texts]  # as in --file=PATH and file:=PATH
    return sorted(
        {text for text in texts if text.startswith("/") and not text.startswith(_SYSTEM)
         and len(text) < _LONGEST_PATH and "\n" not in text and Path(text).exists()}
    )  # fmt: skip
