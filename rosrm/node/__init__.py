"""Base class of migratable nodes: `Node` replaces rclpy's.

Example::

    from rosrm.node import Node

    class Counter(Node):
        def __init__(self):
            super().__init__("counter")
            self.count = 0
            self.output = self.create_publisher(Int64, "count", 10)
            self.create_timer(0.1, self.tick)
            self.keep_state("~/state", Int64, self.save, self.restore)

`docs/how-to/stateful-node.md` has the rest, `docs/reference/handoff-protocol.md` the protocol.
"""

from rosrm.node.arrays import arrays_message, arrays_of
from rosrm.node.migratable import Migratable, Node

__all__ = ["Migratable", "Node", "arrays_message", "arrays_of"]
