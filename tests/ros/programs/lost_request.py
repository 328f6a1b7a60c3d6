"""A service and its client, in two processes of a private network.

`lost_request.py PACE` drops the packet of a request of a client with this pace, and prints the
seconds until the answer: the shortest of three times, because a busy machine may delay some.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

from rosrm import clocks
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import qos
from rosrm.ros.fast_dds import Pace
from rosrm.ros.master_connection import wait_for_service, wait_until
from rosrm.ros.participant import Participant
from rosrm.testing.loopback import enter_private_network
from rosrm_msgs import srv

DOMAIN = 1
#: Port of the first participant of the domain for messages that are not of discovery.
PORT = 7411 + 250 * DOMAIN
#: Drop one packet of the size of a request; heartbeats are smaller.
RULES = f"""flush ruleset
table inet loss {{
  chain received {{
    type filter hook input priority 0; policy accept;
    udp dport {PORT} udp length > 150 quota until 400 bytes drop
  }}
}}
"""
SERVICE = "/rosrm_test/list"
TIMES = 3
#: Seconds.
LIMIT = 10.0


def joined(pace: Pace) -> Participant:
    """Return a participant of rosrm."""
    return Participant(RosSettings(domain=DOMAIN), "one", pace=pace)


def answer_requests() -> None:
    """Offer the service until this process is killed."""
    with joined("eager") as participant:
        participant.serve(srv.List, SERVICE, lambda _, opened: opened.answer(srv.List.Response()))
        print("ready", flush=True)
        while True:
            participant.spin(1.0)


@contextlib.contextmanager
def server() -> Iterator[None]:
    """Offer the service in another process."""
    command = [sys.executable, __file__, "answer"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            yield
        finally:
            process.kill()


def lose(pace: Pace) -> float:
    """Return the seconds from a lost request to its answer."""
    with server(), joined(pace) as participant:
        client = participant.node.create_client(srv.List, SERVICE, qos_profile=qos.SERVICE)
        wait_for_service(participant, client, clocks.boot_time() + LIMIT)

        def ask() -> float:
            begun = clocks.boot_time()
            answer = client.call_async(srv.List.Request())
            wait_until(participant, answer.done, begun + LIMIT)
            return clocks.boot_time() - begun

        def ask_and_lose() -> float:
            subprocess.run(["nft", "-f", "-"], input=RULES, text=True, check=True)
            return ask()

        ask()  # both sides have discovered each other when the answer has come
        return min(ask_and_lose() for _ in range(TIMES))


def main() -> None:
    """Run the program, or its service."""
    if sys.argv[1] == "answer":
        answer_requests()
    elif not enter_private_network():
        print("not permitted")
    else:
        print(lose(sys.argv[1]))


if __name__ == "__main__":
    main()
