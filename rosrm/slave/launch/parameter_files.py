"""Sources of ROS parameters on a host, whose files are read there."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from rosrm.config.parameter_files import parse_parameters
from rosrm.errors import LaunchError
from rosrm.model.parameters import merged_parameters
from rosrm.model.values import ParameterSource, ProcessSpec, qualified_name
from rosrm.runtime.path_calls import at
from rosrm.wording import reason_of

#: Most bytes of a parameters file.
_LARGEST: Final = 1 << 24


def all_parameters(spec: ProcessSpec, started: str = "") -> dict[str, dict[str, Any]]:
    """Return the parameters of a process by pattern of nodes, read on this host.

    `started`: name with which its node is started; "": its own.

    Raises:
        LaunchError: a file cannot be read, or is no parameters file.
    """
    names = (name and qualified_name(spec.namespace, name) for name in (spec.node, started))
    return merged_parameters(_contents(spec), *names)


def _contents(spec: ProcessSpec) -> Iterator[ParameterSource]:
    yield ParameterSource(parameters=spec.parameters)
    for source in spec.parameter_sources:
        if not source.file:
            yield source
            continue
        try:
            for section in parse_parameters(_read(Path(source.file).expanduser())):
                yield replace(section, file=source.file)
        except (OSError, RuntimeError, ValueError) as error:
            why = reason_of(error)
            raise LaunchError(f"parameters file {source.file!r}: {why}") from None


def _read(path: Path) -> str:
    at(path)
    # Without O_NONBLOCK a FIFO without a writer would hold the thread.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError("it is no regular file")
        content = file.read(_LARGEST + 1)
    if len(content) > _LARGEST:
        raise ValueError(f"it has more than {_LARGEST} bytes")
    return content.decode()
