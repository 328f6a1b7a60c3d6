"""Command line arguments and parameters file of a ROS node; pure functions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from rosrm.errors import LaunchError
from rosrm.model.values import ProcessSpec

_BEGIN: Final = "--ros-args"
_END: Final = "--"
#: Escapes of characters that YAML requires escaped and JSON does not escape.
_UNPRINTABLE: Final = {
    code: f"\\u{code:04x}" for code in (*range(0x7F, 0xA0), 0x2028, 0x2029, 0xFEFF, 0xFFFE, 0xFFFF)
}
_LARGEST: Final = 2**63


def ros_arguments(spec: ProcessSpec, node_name: str, parameters_file: str | None) -> list[str]:
    """Return name, namespace, remappings and parameters, to append to the user's arguments.

    `node_name`: "": the nodes keep their own names.
    """
    arguments = [_BEGIN, *(("-r", f"__node:={node_name}") if node_name else ())]
    if spec.namespace:
        namespace = spec.namespace if spec.namespace.startswith("/") else f"/{spec.namespace}"
        arguments += ["-r", f"__ns:={namespace}"]
    for source, target in spec.remappings.items():
        arguments += ["-r", f"{source}:={target}"]
    if parameters_file is not None:
        arguments += ["--params-file", parameters_file]
    return arguments if arguments != [_BEGIN] else []


def join_arguments(arguments: Sequence[str], ros: Sequence[str]) -> list[str]:
    """Return the user's arguments and then ours; close ROS arguments that are still open."""
    is_open = False
    for argument in arguments:
        if argument == _BEGIN:
            is_open = True
        elif argument == _END and is_open:
            is_open = False
    return [*arguments, *([_END] if is_open else []), *ros]


def parameters_text(sections: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a parameters file (YAML) from the parameters of each pattern of nodes.

    Without values the result is "", because ROS 2 rejects an empty file.

    Raises:
        LaunchError: a ROS parameter cannot hold a value.
    """
    lines = []
    for nodes, parameters in sections.items():
        inner = _mapping(parameters, "", 2)
        lines += [f"{_text(nodes)}:", "  ros__parameters:", *inner] if inner else []
    return "\n".join([*lines, ""]) if lines else ""


def _mapping(parameters: Mapping[str, Any], path: str, depth: int) -> list[str]:
    lines = []
    for name, value in parameters.items():
        full = f"{path}{name}"
        indent = "  " * depth
        if isinstance(value, Mapping):
            nested = _mapping(value, f"{full}.", depth + 1)
            lines += [f"{indent}{_text(name)}:", *nested] if nested else []
        elif isinstance(value, (list, tuple)):
            lines.append(f"{indent}{_text(name)}: {_sequence(value, full)}")
        else:
            lines.append(f"{indent}{_text(name)}: {_scalar(value, full)}")
    return lines


def _sequence(values: Sequence[Any], path: str) -> str:
    """Return a ROS array of one type; integers among floats become floats."""
    if not values:
        raise LaunchError(
            f"the parameter {path!r} is an empty list: a parameters file of ROS 2 cannot say of "
            f"which type"
        )
    if any(isinstance(value, float) for value in values) and all(map(_is_number, values)):
        values = [float(value) for value in values]
    types = {type(value) for value in values}
    if len(types) > 1:
        names = ", ".join(sorted(kind.__name__ for kind in types))
        raise LaunchError(f"the parameter {path!r} mixes {names}: a ROS array has one type")
    return f"[{', '.join(_scalar(value, path) for value in values)}]"


def _scalar(value: Any, path: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and -_LARGEST <= value < _LARGEST:
        return str(value)
    if isinstance(value, float):
        return _fraction(value)
    if isinstance(value, str):
        return _text(value)
    raise LaunchError(
        f"the parameter {path!r} is no ROS parameter, which holds a bool, a 64-bit int, a float, "
        f"a text, or a list of one of these\nits value is {value!r}"
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _fraction(value: float) -> str:
    if math.isnan(value):
        return ".nan"
    if math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    text = repr(value)
    # YAML reads an exponent without a point, as in 1e-05, as a text.
    return text if "." in text else text.replace("e", ".0e")


def _text(value: str) -> str:
    """Return a text in double quotes, so that YAML reads no number or bool."""
    return json.dumps(value, ensure_ascii=False).translate(_UNPRINTABLE)
