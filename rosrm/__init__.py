"""rosrm: decides on which host each process of a ROS 2 application runs, and keeps it running."""

from rosrm.version import PROTOCOL_VERSION, __version__

__all__ = ["PROTOCOL_VERSION", "__version__"]
