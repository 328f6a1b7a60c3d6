"""What a node imports to have its whole memory moved: `docs/how-to/portable-node.md`."""

from rosrm_criu.node.portable import PortableNode
from rosrm_criu.node.run_portable import run_portable

__all__ = ["PortableNode", "run_portable"]
