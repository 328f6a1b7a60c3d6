"""Two participants of rosrm on a machine with two network interfaces, `left` and `right`.

`two_interfaces.py FIRST SECOND SECONDS` makes a private network with both interfaces, binds one
participant to the interface FIRST and one to SECOND, and prints whether the second discovers the
first within SECONDS.
"""

from __future__ import annotations

import subprocess
import sys
import time

from pyroute2 import IPRoute

from rosrm.model.ros_settings import RosSettings
from rosrm.ros.participant import Participant
from rosrm.testing.loopback import enter_private_network

ADDRESSES = {"left": "10.1.0.1", "right": "10.2.0.1"}


def add_interfaces() -> None:
    """Add the interfaces to the network of this process."""
    with IPRoute() as network:
        for name, address in ADDRESSES.items():
            network.link("add", ifname=name, kind="veth", peer=f"{name}-peer")
            for end in (name, f"{name}-peer"):
                network.link("set", index=network.link_lookup(ifname=end)[0], state="up")
            index = network.link_lookup(ifname=name)[0]
            network.addr("add", index=index, address=address, prefixlen=24)


def joined(interface: str, name: str) -> Participant:
    """Return a participant that is bound to an interface."""
    return Participant(RosSettings(domain=1, interface=interface), name)


def main() -> None:
    """Run the program, or its first participant until the standard input ends."""
    if sys.argv[1] == "hold":
        with joined(sys.argv[2], "first"):
            print("joined", flush=True)
            sys.stdin.read()
        return
    first, second, seconds = sys.argv[1:]
    if not enter_private_network():
        print("not permitted")
        return
    add_interfaces()
    with (
        subprocess.Popen(
            [sys.executable, __file__, "hold", first], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as held,
        joined(second, "second") as participant,
    ):
        held.stdout.readline()
        deadline = time.monotonic() + float(seconds)
        while "first" not in (names := participant.node.get_node_names()):
            if time.monotonic() > deadline:
                break
            time.sleep(0.02)
        print("discovered" if "first" in names else "not discovered")
        held.stdin.close()


if __name__ == "__main__":
    main()
