"""ROS arguments of a command line, as the keys of a work file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import yaml

_BEGIN: Final = "--ros-args"
_END: Final = "--"
_REMAP: Final = ("-r", "--remap")
_PARAMETER: Final = ("-p", "--param")
_FILE: Final = "--params-file"
_SCALARS: Final = (bool, int, float, str)


class RosWords:
    """The words after a program.

    What a key of a work file can say is taken out. The others stay ROS arguments, such as
    `--log-level debug`, or a rule for one of several nodes.

    Attributes:
        arguments: the user's words, and the ROS arguments that stay.
        has_ros: there were ROS arguments.
        keys: `node_name`, `namespace`, `remappings`, `parameters`, as far as they were given.
    """

    def __init__(self, words: Sequence[str], directory: str) -> None:
        self.keys: dict[str, Any] = {}
        self.has_ros = _BEGIN in words
        plain, ros = _split(words)
        others = self._take_parameters(ros, directory)
        others = self._take_rules(others)
        self.arguments = [*plain, *([_BEGIN, *others] if others else [])]

    def _take_parameters(self, words: Sequence[str], directory: str) -> list[str]:
        """Take all parameters out, or none: their order decides which value holds."""
        sources: list[Any] = []
        others: list[str] = []
        left = iter(words)
        for word in left:
            if word == _FILE:
                sources.append(str(Path(directory) / next(left, "")))
            elif word in _PARAMETER:
                name, mark, text = next(left, "").partition(":=")
                value = _value(text) if mark and name and ":" not in name else None
                if value is None:
                    return list(words)
                sources.append({name: value})
            else:
                others.append(word)
        if sources:
            self.keys["parameters"] = sources
        return others

    def _take_rules(self, words: Sequence[str]) -> list[str]:
        """Take out the rules for names; of several rules for one name, ROS applies the first."""
        remappings: dict[str, str] = {}
        others: list[str] = []
        left = iter(words)
        for word in left:
            if word not in _REMAP:
                others.append(word)
                continue
            rule = next(left, "")
            source, mark, target = rule.partition(":=")
            if source in ("__node", "__name") and target:
                self.keys.setdefault("node_name", target)
            elif source == "__ns" and target:
                self.keys.setdefault("namespace", target)
            elif mark and source and target and ":" not in source:
                remappings.setdefault(source, target)
            else:
                others += [word, rule]
        if remappings:
            self.keys["remappings"] = remappings
        return others


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the user's words and the ROS arguments."""
    plain: list[str] = []
    ros: list[str] = []
    is_open = False
    for word in words:
        if word == _BEGIN:
            is_open = True
        elif word == _END and is_open:
            is_open = False
        else:
            (ros if is_open else plain).append(word)
    return plain, ros


def _value(text: str) -> Any:
    """Return the value of a parameter; None: a work file cannot say it."""
    try:
        value = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError):
        return None
    values = value if isinstance(value, list) else [value]
    return value if values and all(isinstance(one, _SCALARS) for one in values) else None
