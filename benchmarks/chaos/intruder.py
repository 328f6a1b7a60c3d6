"""A stranger in the ROS domain of a lab: it repeats, changes and invents messages all the time.

It has no key. It records the messages of all topics, and offers a second server of each service,
so that DDS gives it the requests, too. Started by `--intruder` on the host of the master.
"""

from __future__ import annotations

import contextlib
import os
import random
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from rclpy._rclpy_pybind11 import RCLError
from rclpy.serialization import serialize_message

from benchmarks.chaos.cluster import DESK, HOSTS
from benchmarks.chaos.work import ROOT
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import names, qos
from rosrm.ros.participant import OpenRequest, Participant
from rosrm.ros.sealed import envelope_to_msg
from rosrm.ros.sealed_codec import Envelope, decode, encode
from rosrm_lab import Lab
from rosrm_msgs import msg, srv

#: Deliveries a second, over all receivers of all messages, requests and answers.
RATE: Final = 200.0
#: Sent messages by which the intruder tells its own ones from those to record.
_MOST_OWN: Final = 100
#: Recorded messages of each topic and service that are repeated.
_MOST_RECORDED: Final = 500
#: Seconds between two lines about the number of messages.
_TOLD_EVERY: Final = 10.0
_BIG: Final = 100_000
_PATH: Final = names.Names("/rosrm")
_TOPICS: Final = {
    names.RESOURCE_INFO: (msg.SealedReading, qos.READING_OUT),
    names.PROCESS_STATUS: (msg.Sealed, qos.STATUSES),
    names.PROCESS_USAGE: (msg.Sealed, qos.STATUSES),
    names.SNAPSHOT_REPORTS: (msg.Sealed, qos.STATUSES),
    names.MASTER_BEAT: (msg.Signed, qos.BEAT),
    names.STATE_CONFIG: (msg.Sealed, qos.STATE_CONFIG),
}
_OF_MASTER: Final = (
    names.HANDSHAKE, names.REGISTER_HOST, names.LEAVE, names.REQUEST_PROCESS, names.SUBMIT,
    names.CANCEL, names.RESTART, names.MIGRATE, names.CHECKPOINT, names.RESTORE,
    names.SET_HOST_STATE, names.PRUNE, names.LIST, names.EXPLAIN, names.INTRODUCE,
)  # fmt: skip
_OF_SLAVES: Final = (
    names.CONTROL, names.READ_LOG, names.STORE_REPLICA, names.READ_SNAPSHOT,
)  # fmt: skip


@contextlib.contextmanager
def intruder(lab: Lab, log: Path) -> Iterator[None]:
    """Let an intruder send from the host of the master."""
    command = [sys.executable, "-m", "benchmarks.chaos.intruder"]
    with log.open("ab") as sink:
        process = lab.popen(
            DESK, command, cwd=str(ROOT), stdin=subprocess.PIPE, stdout=sink, stderr=sink
        )
    try:
        yield
        if process.poll() is not None:
            raise RuntimeError(f"the intruder ended with {process.returncode}, see {log}")
    finally:
        process.kill()
        process.communicate()


class Intruder:
    """A participant without a key, which sends one message at a time.

    Attributes:
        delivered: number of deliveries of its messages and answers.
    """

    def __init__(self, participant: Participant, seed: int) -> None:
        self._participant = participant
        self._random = random.Random(seed)  # noqa: S311 - a repeatable draw
        self._recorded: dict[str, deque[bytes]] = {}
        self._own: deque[bytes] = deque(maxlen=_MOST_OWN)
        self._send: dict[str, Callable[[bytes], object]] = {}
        self._receivers: dict[str, Callable[[], int]] = {}
        self.delivered = 0
        for name, (kind, profile) in _TOPICS.items():
            self._join_topic(_PATH(name), kind, profile)
        for name in _OF_MASTER:
            self._join_service(_PATH(name))
        for host in HOSTS:
            for name in _OF_SLAVES:
                self._join_service(_PATH.of_host(host, name))

    def _recorder(self, name: str) -> Callable[[bytes], None]:
        """Return a function that records the messages of others."""
        recorded = self._recorded[name] = deque(maxlen=_MOST_RECORDED)

        def record(data: bytes) -> None:
            if data not in self._own:
                recorded.append(data)

        return record

    def _join_topic(self, topic: str, kind: Any, profile: Any) -> None:
        node = self._participant.node
        node.create_subscription(kind, topic, self._recorder(topic), profile, raw=True)
        publisher = node.create_publisher(kind, topic, profile)
        self._send[topic] = publisher.publish
        self._receivers[topic] = publisher.get_subscription_count

    def _join_service(self, service: str) -> None:
        node = self._participant.node
        record = self._recorder(service)
        client = node.create_client(srv.Sealed, service, qos_profile=qos.SERVICE)

        def take(request: srv.Sealed.Request, opened: OpenRequest) -> None:
            record(serialize_message(request.message))
            opened.answer(srv.Sealed.Response(message=request.message))
            self.delivered += node.count_clients(service)

        def send(data: bytes) -> None:
            found = decode(data)
            if found is not None:
                message = envelope_to_msg(found)
                future = client.call_async(srv.Sealed.Request(message=message))
                client.remove_pending_request(future)

        self._participant.serve(srv.Sealed, service, take)
        self._send[service] = send
        self._receivers[service] = lambda: node.count_services(service)

    def send_one(self) -> None:
        """Send a recorded message as it was or with changes, or an invented one."""
        name = self._random.choice(list(self._send))
        recorded = self._recorded[name]
        data = self._random.choice(recorded) if recorded else self._invented()
        change = self._random.choice((_unchanged, _newer, _of_another_run, _damaged))
        if self._random.random() < 0.3:
            data = self._invented()
        sent = change(data)
        self._own.append(sent)
        with contextlib.suppress(RCLError):  # the sender's own library refuses some sizes
            self._send[name](sent)
            self.delivered += max(1, self._receivers[name]())

    def _invented(self) -> bytes:
        principal = self._random.choice(
            ("user:root", f"host:{self._random.choice(HOSTS)}", "host:new", "", 600 * "x")
        )
        body = os.urandom(self._random.choice((0, 60, 1000, _BIG)))
        run = os.urandom(16)
        return encode(Envelope(1, principal, 0, run, run, 2**40, body))


def _unchanged(data: bytes) -> bytes:
    return data


def _damaged(data: bytes) -> bytes:
    at = len(data) // 2
    return data[:at] + os.urandom(1) + data[at + 1 :]


def _newer(data: bytes) -> bytes:
    found = decode(data)
    return data if found is None else encode(found._replace(counter=2**50))


def _of_another_run(data: bytes) -> bytes:
    found = decode(data)
    return data if found is None else encode(found._replace(run=os.urandom(16)))


def main() -> None:
    """Send until this process is killed."""
    with Participant(RosSettings(), "intruder") as participant:
        sender, told_at = Intruder(participant, seed=1), time.monotonic()
        due, paid = told_at, 0
        while True:
            now = time.monotonic()
            if now >= due:
                sender.send_one()
            due = max(due, now) + (sender.delivered - paid) / RATE
            paid = sender.delivered
            participant.spin(max(0.0, due - now))
            if time.monotonic() - told_at >= _TOLD_EVERY:
                told_at = time.monotonic()
                cpu = time.process_time()
                print(f"{sender.delivered} deliveries, {cpu:.1f} s of CPU", flush=True)


if __name__ == "__main__":
    main()
