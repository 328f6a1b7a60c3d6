"""Files of ROS parameters, as ROS reads them."""

from __future__ import annotations

import re
from typing import Any

import yaml

from rosrm.model.parameters import sections_of
from rosrm.model.values import ParameterSource
from rosrm.wording import one_line


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


def _untagged(loader: _RosLoader, _tag: str, node: Any) -> Any:
    """Return a value whose tag ROS does not read, such as a tuple that launch has written."""
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_scalar(node)


_RosLoader.add_multi_constructor("tag:yaml.org,2002:python/", _untagged)


def parse_parameters(text: str) -> tuple[ParameterSource, ...]:
    """Return the sections of a ROS parameters file; raises `ValueError` for another document."""
    try:
        document = yaml.load(text, _RosLoader)  # noqa: S506 - a SafeLoader
    except yaml.YAMLError as error:
        raise ValueError(one_line(str(error))) from None
    return () if document is None else tuple(sections_of(document))
