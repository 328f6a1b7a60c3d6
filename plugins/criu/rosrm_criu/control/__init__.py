"""How a running node is asked to leave the ROS graph and to join it again, through small files.

A process that is to be dumped by CRIU may hold no socket and no pipe to the outside, so it is
spoken to by two files in a directory of its own and a signal that wakes it: `messages` has the
files, `client` is for who asks, `listener` for the node. Nothing here needs ROS.
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
