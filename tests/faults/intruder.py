"""A participant in the domain of a cluster that sends what it likes, with a key or without one."""

from __future__ import annotations

import contextlib
import os
from array import array
from collections.abc import Callable, Iterator
from typing import Any, Final

from rclpy._rclpy_pybind11 import RCLError

from rosrm import clocks
from rosrm.keys import key_files
from rosrm.keys.cluster import ClusterSecret, PrincipalKey, own_grant
from rosrm.keys.derivation import KEY_BYTES
from rosrm.keys.roles import principal_of
from rosrm.keys.security import MasterSecurity, MemberSecurity, NoSecurity, Peer
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import names, qos
from rosrm.ros.control import ControlClient
from rosrm.ros.participant import Participant
from rosrm.ros.sealed import SealedClient, SealedEndpoints
from rosrm.ros.sealed_codec import decode
from rosrm_msgs import msg, srv
from tests.waiting import PATIENCE, wait_until

path = names.Names("/rosrm")

#: Services of the master and of each slave, with the types of the plain messages.
MASTER_SERVICES: Final = {
    names.SUBMIT: srv.Submit, names.CANCEL: srv.Cancel, names.RESTART: srv.Restart,
    names.MIGRATE: srv.Migrate, names.CHECKPOINT: srv.Checkpoint, names.RESTORE: srv.Restore,
    names.SET_HOST_STATE: srv.SetHostState, names.PRUNE: srv.Prune, names.LIST: srv.List,
    names.REBALANCE: srv.Rebalance, names.RELOAD: srv.Reload,
    names.EXPLAIN: srv.Explain, names.INTRODUCE: srv.Introduce, names.HANDSHAKE: srv.Handshake,
    names.REGISTER_HOST: srv.RegisterHost, names.LEAVE: srv.Leave,
    names.REQUEST_PROCESS: srv.RequestProcess,
}  # fmt: skip
SLAVE_SERVICES: Final = {
    names.CONTROL: srv.ControlHost, names.READ_LOG: srv.ReadLog,
    names.STORE_REPLICA: srv.StoreReplica, names.READ_SNAPSHOT: srv.ReadSnapshot,
}  # fmt: skip
#: Topics with the types of their messages, and profiles to which all receivers and senders fit.
TOPICS: Final = {
    path(names.RESOURCE_INFO): (msg.SealedReading, qos.READINGS),
    path(names.PROCESS_STATUS): (msg.Sealed, qos.STATUSES),
    path(names.PROCESS_USAGE): (msg.Sealed, qos.STATUSES),
    path(names.SNAPSHOT_REPORTS): (msg.Sealed, qos.STATUSES),
    path(names.MASTER_BEAT): (msg.Signed, qos.BEAT),
    path(names.MASTER_LOAD): (msg.Signed, qos.LOAD),
    path(names.STATE_CONFIG): (msg.Sealed, qos.STATE_CONFIG),
    path.stranded_sources: (msg.Sealed, qos.HANDOFF),
}


EVE: Final = own_grant(principal_of("user:eve"))
#: Bytes of a message above which it is not recorded.
MOST_HEARD: Final = 10_000


def services(*hosts: str) -> dict[str, Any]:
    """Return all services of a cluster by name, with the types of their plain messages."""
    of_slaves = {
        path.of_host(host, name): kind
        for host in hosts for name, kind in SLAVE_SERVICES.items()
    }  # fmt: skip
    return {path(name): kind for name, kind in MASTER_SERVICES.items()} | of_slaves


def public_key() -> bytes:
    """Return the master's public key, which every member has."""
    return bytes(key_files.read_secret(key_files.key_home()).signing_key.verify_key)


def false_member(principal: str) -> MemberSecurity:
    """Return the security of a member whose key and master are drawn at random."""
    grant = own_grant(principal_of(principal))
    return MemberSecurity(PrincipalKey(grant, os.urandom(KEY_BYTES), os.urandom(KEY_BYTES)))


def false_master() -> MasterSecurity:
    """Return the security of a master with another secret."""
    return MasterSecurity(ClusterSecret(os.urandom(KEY_BYTES)))


class Intruder:
    """A participant that hears all topics, and offers a second server of all services on demand.

    Args:
        key: public key of the master; None: it is read from the key files of this user.

    Attributes:
        heard: serialised messages by topic.
        overheard: requests by service, since the second servers were offered.
        beat: newest beat of the master, which everybody can read.
        runs: of the master ("") and of hosts, by name, as far as messages show them.
    """

    def __init__(self, settings: RosSettings, *hosts: str, key: bytes | None = None) -> None:
        self.participant = Participant(settings, "intruder")
        self.hosts = hosts
        self.heard: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        self.overheard: dict[str, list[msg.Sealed]] = {}
        self.beat = msg.MasterBeat()
        self.runs: dict[str, bytes] = {}
        self.control = ControlClient(self.participant, "intruder")
        self._publishers: dict[str, Any] = {}
        self._clients: dict[tuple[str, int], SealedClient] = {}
        self._plain: dict[str, Any] = {}
        reader = MemberSecurity(PrincipalKey(EVE, os.urandom(KEY_BYTES), key or public_key()))
        topic = path(names.MASTER_BEAT)
        self.endpoints(reader).follow(msg.MasterBeat, topic, qos.BEAT_IN, self._take_beat)
        for topic, (kind, profile) in TOPICS.items():
            self.participant.node.create_subscription(
                kind, topic, self._hears(topic), profile, raw=True
            )

    def _take_beat(self, beat: msg.MasterBeat, run: bytes) -> None:
        self.beat, self.runs[""] = beat, run

    def _hears(self, topic: str) -> Callable[[bytes], None]:
        def hear(data: bytes) -> None:
            if len(data) > MOST_HEARD:
                return
            self.heard[topic].append(data)
            sealed = decode(data) if topic == path(names.PROCESS_STATUS) else None
            if sealed is not None and sealed.principal.startswith("host:"):
                self.runs.setdefault(sealed.principal.removeprefix("host:"), sealed.run)

        return hear

    def close(self) -> None:
        self.participant.close()

    def spin(self, seconds: float) -> None:
        """Handle messages for some seconds."""
        until = clocks.boot_time() + seconds
        while (left := until - clocks.boot_time()) > 0.0:
            self.participant.spin(left)

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        return wait_until(condition, what, pause=self.participant.spin)

    def wait_for_beat(self) -> None:
        """Wait for the next beat, so that the age of a request is right."""
        before = self.beat.beat
        self.wait(lambda: self.beat.beat != before, "a beat")

    # --- raw messages ----------------------------------------------------------------------

    def publish(self, topic: str, data: bytes) -> None:
        """Publish bytes on a topic."""
        if topic not in self._publishers:
            kind, profile = TOPICS[topic]
            made = self.participant.node.create_publisher(kind, topic, profile)
            self._publishers[topic] = made
            self.spin(0.3)
        with contextlib.suppress(RCLError):  # the sender's own library refuses some sizes
            self._publishers[topic].publish(data)

    def call(self, service: str, message: msg.Sealed) -> Any:
        """Send a sealed request; return the future of its answer."""
        if service not in self._plain:
            made = self.participant.node.create_client(srv.Sealed, service, qos_profile=qos.SERVICE)
            self._plain[service] = made
            self.wait(made.service_is_ready, f"the service {service}")
            self.spin(0.1)
        return self._plain[service].call_async(srv.Sealed.Request(message=message))

    def overhear(self) -> None:
        """Offer a second server of each service, which answers first, and as often as it likes."""
        for service in services(*self.hosts):
            self.participant.serve(srv.Sealed, service, self._overhears(service))

    def _overhears(self, service: str) -> Callable[[Any, Any], None]:
        heard = self.overheard[service] = []

        def take(request: Any, opened: Any) -> None:
            message = request.message
            heard.append(message)
            for body in (b"", bytes(message.body), os.urandom(60)):
                opened.answer(srv.Sealed.Response(message=sealed_like(message, body=body)))

        return take

    # --- messages under keys ---------------------------------------------------------------

    def endpoints(self, security: Any) -> SealedEndpoints[Any]:
        """Return what sends under the keys of a security, which may be false."""
        return SealedEndpoints(self.participant, security)

    def as_master(self, security: MasterSecurity | NoSecurity, host: str) -> Peer:
        """Return a slave, as a master with these keys sees it."""
        peer = security.peer(f"host:{host}", 0)
        peer.run = self.runs[host]
        return peer

    def ask(self, security: Any, service: str, peer: Peer, request: Any) -> Any:
        """Send a request under the keys of a security; return the future of its answer."""
        kind = services(*self.hosts)[service]
        key = service, id(security)
        if key not in self._clients:
            made = self.endpoints(security).client(kind, service, peer)
            self._clients[key] = made
            self.wait(made.service_is_ready, f"the service {service}")
            self.spin(0.1)
        client = self._clients[key]
        client.peer = peer
        if hasattr(request, "envelope"):
            of_slave = service.startswith(path("host/"))
            beat = clocks.boot_time_ns() if of_slave else self.beat.beat
            request.envelope = self.control.envelope(beat, 2**62 if of_slave else self.beat.epoch)
        return client.call_async(request)

    def ask_master(self, security: Any, name: str, request: Any) -> Any:
        """Send a request to the master; return the future of its answer."""
        security.master.run = self.runs[""]
        return self.ask(security, path(name), security.master, request)

    def answer(self, future: Any, seconds: float = 1.0) -> Any:
        """Return the answer to a request; None: none came in this time."""
        until = clocks.boot_time() + seconds
        while not future.done() and clocks.boot_time() < until:
            self.participant.spin(0.05)
        return future.result() if future.done() else None

    def answer_of_master(self, security: Any, name: str, request: Any) -> Any:
        """Return the answer of the master to a member, whose request may be repeated."""
        until = clocks.boot_time() + PATIENCE
        while clocks.boot_time() < until:
            self.wait_for_beat()
            response = self.answer(self.ask_master(security, name, request))
            if response is not None:
                return response
        raise AssertionError(f"no answer to {name}")


def sealed_like(message: msg.Sealed, **changes: Any) -> msg.Sealed:
    """Return a copy of a sealed message with other fields."""
    fields = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
    as_arrays = {
        name: array("B", value) if isinstance(value, bytes) else value
        for name, value in changes.items()
    }
    return msg.Sealed(**{**fields, **as_arrays})


def random_sealed(principal: str = "", body: int = 60) -> msg.Sealed:
    """Return a sealed message of random bytes."""
    return msg.Sealed(
        format=1, principal=principal, generation=0, run=array("B", os.urandom(16)),
        receiver_run=array("B", os.urandom(16)), counter=2**40,
        body=array("B", os.urandom(body)),
    )  # fmt: skip


def strange_principals() -> Iterator[str]:
    """Yield texts that claim to be principals."""
    yield from (
        "",
        ":",
        "host:",
        "user:\x1b[31m",
        "host:../../etc/passwd",
        "host:h0\n",
        "\N{SNOWMAN}",
    )
    yield from (
        "user:" + 128 * "x",
        513 * "x",
        100_000 * "x",
        f"ticket:{2**63}:1:read_log:0:p:user:x",
    )
    yield from ("ticket:99999999999999999999999:1:control:p:host:h0", "instance:p#1", "handoff:p#2")
    yield from (f"instance:p#{10**300}", "ticket:", "ticket:1:::", "user:rosrm-master")
