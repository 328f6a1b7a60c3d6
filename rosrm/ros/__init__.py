"""ROS layer: transport, graph, message <-> value. Only it and `rosrm.node` import rclpy."""

import sys
from typing import Any

from rosrm.ros.lazy_types import import_types_lazily

_modules: dict[str, Any] = sys.modules
# Generated messages import the code generator, which they do not use: 60 ms of every command. None
# makes this import fail, and the generator's package tolerates that.
_modules.setdefault("rosidl_generator_py.generate_py_impl", None)
import_types_lazily()
