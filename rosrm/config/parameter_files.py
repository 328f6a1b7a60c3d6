"""Files of ROS parameters, as ROS reads them."""

from __future__ import annotations

import re
from typing import Any, Final

import yaml

from rosrm.model.parameters import sections_of
from rosrm.model.values import ParameterSource
from rosrm.wording import one_line

#: Maximum number of characters of a file.
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


def _untagged(loader: _RosLoader, _tag: str, node: Any) -> Any:
    """Return a value whose tag ROS does not read, such as a tuple that launch has written."""
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_scalar(node)


_RosLoader.add_multi_constructor("tag:yaml.org,2002:python/", _untagged)


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """Return the number of characters of a document in which each alias is written out.

    `known`: sizes of nodes that were met before; an alias that contains itself has no end.
    """
    if id(node) not in known:
        known[id(node)] = _LARGEST + 1
        inner = node.value
        if isinstance(node, yaml.MappingNode):
            inner = [one for pair in node.value for one in pair]
        known[id(node)] = 1 + (
            len(inner) if isinstance(inner, str) else sum(_size(one, known) for one in inner)
        )
    return known[id(node)]


def parse_parameters(text: str) -> tuple[ParameterSource, ...]:
    """Return the sections of a ROS parameters file; raises `ValueError` for another document."""
    try:
        loader = _RosLoader(text)
        root = loader.get_single_node()
        if root is not None and _size(root, {}) > _LARGEST:
            raise ValueError(f"with its aliases it has more than {_LARGEST} characters")
        document = None if root is None else loader.construct_document(root)
    except yaml.YAMLError as error:
        raise ValueError(one_line(str(error))) from None
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    return () if document is None else tuple(sections_of(document))
