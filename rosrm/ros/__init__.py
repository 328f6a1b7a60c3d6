"""The only place that imports rclpy, with `rosrm.node`: transport, graph, message <-> value."""

import sys
from typing import Any

_modules: dict[str, Any] = sys.modules
# Generated messages import the code generator, which they do not use: 60 ms of every command. The
# generator's package copes with an import that fails, and None makes this one fail.
_modules.setdefault("rosidl_generator_py.generate_py_impl", None)
