"""A node with the profile of migratable nodes, in a private network.

Prints two sizes: the largest receive buffer of the node's UDP sockets, and the buffer of a socket
for which BYTES were requested (`socket_buffers.py BYTES`). Prints "not permitted" if no private
network can be made.
"""

from __future__ import annotations

import os
import socket
import sys

import rclpy

from rosrm.ros.fast_dds import announcing
from rosrm.ros.graph_remains import open_sockets
from rosrm.testing.loopback import enter_private_network


def room(one: socket.socket) -> int:
    """Return the bytes of a socket's receive buffer, as the kernel limits them."""
    return one.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def main() -> None:
    """Print both numbers."""
    if not enter_private_network():
        print("not permitted")
        return
    rclpy.init(domain_id=1)
    with announcing(os.environ, "steady", udp=False):
        node = rclpy.create_node("one")
    sockets = [socket.socket(fileno=os.dup(number)) for number in open_sockets()]
    largest = max(room(one) for one in sockets if one.type == socket.SOCK_DGRAM)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, int(sys.argv[1]))
        print(largest, room(asked))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
