"""Node library for migration with the whole memory: see `docs/how-to/portable-node.md`."""

from rosrm_criu.node.portable import PortableNode
from rosrm_criu.node.run_portable import run_portable

__all__ = ["PortableNode", "run_portable"]
