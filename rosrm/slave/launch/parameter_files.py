"""Sources of ROS parameters on a host: files are read, and the sections of its node are kept."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from rosrm.config.parameter_files import parse_parameters
from rosrm.errors import LaunchError
from rosrm.model.parameters import merged_parameters
from rosrm.model.values import ParameterSource, ProcessSpec, qualified_name

#: Most bytes of a parameters file.
_LARGEST: Final = 1 << 24


def all_parameters(spec: ProcessSpec, node_name: str) -> dict[str, dict[str, Any]]:
    """Return the parameters of a process by pattern of nodes, read on this host.

    `node_name`: visible name of its node; "": unknown.

    Raises:
        LaunchError: a file cannot be read, or is no parameters file.
    """
    name = qualified_name(spec.namespace, node_name) if node_name else ""
    return merged_parameters(_contents(spec), name)


def _contents(spec: ProcessSpec) -> Iterator[ParameterSource]:
    yield ParameterSource(parameters=spec.parameters)
    for source in spec.parameter_sources:
        if not source.file:
            yield source
            continue
        try:
            yield from parse_parameters(_read(Path(source.file).expanduser()))
        except (OSError, RuntimeError, ValueError) as error:
            why = getattr(error, "strerror", None) or str(error)
            raise LaunchError(f"parameters file {source.file!r}: {why}") from None


def _read(path: Path) -> str:
    with path.open("rb") as file:
        content = file.read(_LARGEST + 1)
    if len(content) > _LARGEST:
        raise ValueError(f"it has more than {_LARGEST} bytes")
    return content.decode()
