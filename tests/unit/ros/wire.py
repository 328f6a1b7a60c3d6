"""Fake participant: stores what is sent, and lets a test answer requests and publish messages."""

from __future__ import annotations

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
    """Fake participant, and its node."""

    settings = type("Settings", (), {"namespace": "/rosrm"})

    def __init__(self) -> None:
        self.node = self
        self.guard = CallbackGuard()
        self.to: dict[type, Peer] = {}
        self.hear = {}

    def create_client(self, kind, _name, *, qos_profile) -> Peer:
        return self.to.setdefault(kind, Peer())

    def create_publisher(self, _kind, _name, _qos) -> Peer:
        return Peer()

    def create_subscription(self, kind, _name, callback, _qos) -> None:
        self.hear[kind] = callback

    def counted(self, callback):
        return callback

    def serve(self, *_arguments) -> None:
        pass
