"""File-based requests to a running node to leave the ROS graph and to rejoin it.

A process that CRIU is to dump may hold no socket and no pipe to the outside. So requests and
answers are two files in a directory per node, and a signal wakes the node. `messages` defines the
files, `client` is the requesting side, `listener` the node's side. Nothing here needs ROS.
"""
