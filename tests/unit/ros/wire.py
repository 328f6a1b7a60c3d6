"""Fake of `SealedEndpoints`: stores what is sent; a test answers requests and publishes."""

from __future__ import annotations

from rosrm.keys.roles import Principal
from rosrm.keys.security import NoSecurity
from rosrm.ros.callback_guard import CallbackGuard


class Call:
    """Request on its way, with its result."""

    def __init__(self, request) -> None:
        self.request = request
        self._done = None

    def add_done_callback(self, done) -> None:
        self._done = done

    def answer(self, response) -> None:
        self._response = response
        self._done(self)

    def result(self):
        return self._response


class Peer:
    """Fake service client and publisher that store what is sent."""

    def __init__(self) -> None:
        self.sent: list[Call] = []

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request) -> Call:
        self.sent.append(Call(request))
        return self.sent[-1]

    def remove_pending_request(self, call) -> None:
        pass

    def publish(self, message) -> None:
        pass


class Wire:
    """Fake of endpoints, and of their participant and node.

    Args:
        principal: the part whose endpoints these are; None: the master.
    """

    settings = type("Settings", (), {"namespace": "/rosrm"})

    def __init__(self, principal: Principal | None = None) -> None:
        self.participant = self.node = self
        self.security = NoSecurity(principal)
        self.guard = CallbackGuard()
        self.to: dict[type, Peer] = {}
        self.hear = {}

    def refused(self, name: str) -> None:
        raise AssertionError(f"a message on {name} was refused")

    def client(self, kind, _name, _peer, **_named) -> Peer:
        return self.to.setdefault(kind, Peer())

    def publisher(self, _kind, _name, _qos, _peer) -> Peer:
        return Peer()

    def create_publisher(self, _kind, _name, _qos) -> Peer:
        return Peer()

    def follow(self, kind, _name, _qos, take) -> None:
        self.hear[kind] = lambda message: take(message, b"")

    def counted(self, callback):
        return callback

    def serve(self, *_arguments) -> None:
        pass
