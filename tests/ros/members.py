"""Principals with genuine keys, which send messages that no part of rosrm sends."""

from __future__ import annotations

from typing import Any, Generic

from rosrm import clocks
from rosrm.keys.finding import host_security, master_security, user_security
from rosrm.keys.security import UNKNOWN_RUN, Authority, Member, Peer
from rosrm.ros import names
from rosrm.ros.control import ControlClient
from rosrm.ros.master_connection import wait_for_service
from rosrm.ros.participant import Participant
from rosrm.ros.sealed import SealedClient, SealedEndpoints, SealedPublisher, SecurityT
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv
from tests.ros.calls import answer_to
from tests.waiting import PATIENCE, wait_until

path = names.Names("/rosrm")


class Player(Generic[SecurityT]):
    """A principal that sends messages to a peer.

    Attributes:
        endpoints: of the principal.
        control: makes envelopes.
    """

    def __init__(self, participant: Participant, security: SecurityT, peer: Peer) -> None:
        self.participant = participant
        self.endpoints = SealedEndpoints(participant, security)
        self.control = ControlClient(participant, "player")
        self._peer = peer
        self._clients: dict[str, SealedClient] = {}

    def client(self, kind: Any, name: str) -> SealedClient:
        """Return a client of a discovered service of the peer."""
        if name not in self._clients:
            client = self.endpoints.client(kind, name, self._peer, first_contact=True)
            assert wait_for_service(self.participant, client, clocks.boot_time() + PATIENCE), name
            self._clients[name] = client
        return self._clients[name]

    def ask(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service; repeat requests that are lost before discovery is complete.

        The first answer names the run of the peer, and any later request is for that run.
        """
        deadline = clocks.boot_time() + PATIENCE
        while clocks.boot_time() < deadline:
            is_first = self._peer.run == UNKNOWN_RUN and kind is not srv.Handshake
            future = self.client(kind, name).call_async(request)
            response = answer_to(self.participant, future, clocks.boot_time() + 2.0)
            if response is not None and not is_first:
                return response
        raise AssertionError(f"no answer of {name}")

    def publisher(self, kind: Any, name: str, profile: Any) -> SealedPublisher:
        """Return a publisher that has been discovered."""
        publisher = self.endpoints.publisher(kind, path(name), profile, self._peer)
        self.await_reader(publisher._publisher)
        return publisher

    def await_reader(self, publisher: Any) -> None:
        """Wait until a publisher of rclpy has a subscription."""
        wait_until(
            publisher.get_subscription_count, f"a subscription to {publisher.topic_name}",
            pause=self.participant.spin,
        )  # fmt: skip


class PlayedMember(Player[Member]):
    """A user or host, whose peer is the master."""

    def hello(self, **changes: Any) -> srv.Handshake.Response:
        """Return the master's answer to a handshake."""
        fields = {
            "protocol_version": PROTOCOL_VERSION, "software_version": "x", "role": "client",
            "name": "player",
        }  # fmt: skip
        request = srv.Handshake.Request(**{**fields, **changes})
        return self.ask(srv.Handshake, path(names.HANDSHAKE), request)

    def envelope(self, **changes: Any) -> Any:
        """Return an envelope for the master, with some fields changed."""
        hello = self.hello()
        envelope = self.control.envelope(hello.beat, hello.epoch)
        for name, value in changes.items():
            setattr(envelope, name, value)
        return envelope


def play_user(participant: Participant) -> PlayedMember:
    """Return the user who runs the tests."""
    security = user_security("keys")
    return PlayedMember(participant, security, security.master)


def play_host(participant: Participant, name: str) -> PlayedMember:
    """Return a host of this name."""
    security = host_security("keys", name)
    assert security is not None
    return PlayedMember(participant, security, security.master)


def play_master(participant: Participant, host: str) -> Player[Authority]:
    """Return another master of the same cluster, whose peer is the slave of a host."""
    security = master_security("keys")
    peer = security.peer(f"host:{host}", 0)
    assert peer is not None
    return Player(participant, security, peer)
