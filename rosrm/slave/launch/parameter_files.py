"""Sources of ROS parameters on a host: files are read, and the sections of its node are kept."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import yaml

from rosrm.errors import LaunchError
from rosrm.model.parameters import merged_parameters, sections_of
from rosrm.model.values import ParameterSource, ProcessSpec, qualified_name
from rosrm.wording import one_line

#: Most bytes of a parameters file.
_LARGEST: Final = 1 << 24


class _RosLoader(yaml.SafeLoader):
    """YAML as ROS reads parameter files: `1e3` is a number, and each key is text."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping whose keys are text, also `on` and `1`."""
        self.flatten_mapping(node)
        return {str(key.value): self.construct_object(item, deep) for key, item in node.value}


_RosLoader.yaml_implicit_resolvers = {
    first: [one for one in resolvers if one[0] != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_RosLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+"), list("-+0123456789")
)


def parse_parameters(text: str) -> tuple[ParameterSource, ...]:
    """Return the sections of a ROS parameters file; raises `ValueError` for another document."""
    try:
        document = yaml.load(text, _RosLoader)  # noqa: S506 - a SafeLoader
    except yaml.YAMLError as error:
        raise ValueError(one_line(str(error))) from None
    return () if document is None else tuple(sections_of(document))


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
