"""File-based requests to a running node to leave the ROS graph and to rejoin it.

A process that CRIU is to dump may hold no socket and no pipe to the outside. So requests and
answers are two files in a directory per node, and a signal wakes the node. `messages` defines the
files, `client` is the requesting side, `listener` the node's side. Nothing here needs ROS.
"""

from rosrm_criu.control.client import (
    ask_prepare,
    ask_resume,
    await_joined,
    await_left,
    control_directory,
    control_root,
    directory_of,
    listens,
    make_directory,
    remove_directory,
    status_of,
)
from rosrm_criu.control.messages import SIGNAL, VARIABLE, Request, State, Status, Want

__all__ = [
    "SIGNAL",
    "VARIABLE",
    "Request",
    "State",
    "Status",
    "Want",
    "ask_prepare",
    "ask_resume",
    "await_joined",
    "await_left",
    "control_directory",
    "control_root",
    "directory_of",
    "listens",
    "make_directory",
    "remove_directory",
    "status_of",
]
