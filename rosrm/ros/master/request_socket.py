"""Requests that arrive on the socket of the master, see `rosrm.ros.master_socket`."""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import threading
from typing import TYPE_CHECKING, Final

from rosrm import clocks, threads
from rosrm.keys.security import Authority
from rosrm.ros import master_socket
from rosrm.ros.sealed import SealedEndpoints
from rosrm.ros.sealed_codec import Envelope, encode
from rosrm.wording import reason_of

if TYPE_CHECKING:
    from typing_extensions import Self

_log = logging.getLogger("rosrm.master")

#: Threads, and so connections at a time. About as many others wait; further clients use DDS.
_THREADS: Final = 8
#: Seconds for a request to arrive, and for its answer to be sent.
_TRANSFER: Final = 1.0
#: Seconds for the decision. After them the client repeats its request over DDS.
_DECISION: Final = 2.0


class RequestSocket:
    """Threads that read requests and write answers; the services handle them in the loop.

    So a slow or silent client never blocks the loop, and occupies a thread for at most 4 s.
    """

    def __init__(self, endpoints: SealedEndpoints[Authority]) -> None:
        self._endpoints = endpoints
        self._closed = threading.Event()
        self._listener = socket.socket(socket.AF_UNIX)
        address = master_socket.address(endpoints.participant.settings, endpoints.security)
        if not address:
            return
        try:
            self._listener.bind(address)
        except OSError as fault:
            _log.warning(
                "requests of this machine come over DDS, because the socket cannot be bound: %s",
                reason_of(fault),
            )
            return
        self._listener.listen(_THREADS)
        for number in range(_THREADS):
            threads.start(self._work, f"requests-{number}", again=True)

    def _work(self) -> None:
        while not self._closed.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:  # the listener is closed, or this process has too many open files
                self._closed.wait(_TRANSFER)
                continue
            with connection:
                try:
                    self._serve(connection)
                except (OSError, queue.Empty):  # the client uses DDS instead
                    continue
                except Exception:  # noqa: BLE001 - a fault in one request must end no thread
                    _log.exception("a request on the socket of this machine has failed")

    def _serve(self, connection: socket.socket) -> None:
        until = clocks.boot_time() + _TRANSFER
        content = master_socket.receive(connection, master_socket.MOST_REQUEST, until)
        service, envelope = master_socket.service_and_envelope(content)
        take = self._endpoints.handlers.get(service)
        if take is not None and not self._closed.is_set():
            answers: queue.SimpleQueue[Envelope] = queue.SimpleQueue()
            # Queued behind earlier messages: a repetition over DDS must be opened after this one.
            self._endpoints.participant.post(take, envelope, answers.put)
            answer = encode(answers.get(timeout=_DECISION))
            master_socket.send(connection, answer, clocks.boot_time() + _TRANSFER)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        with contextlib.suppress(OSError):  # it does not listen
            self._listener.shutdown(socket.SHUT_RDWR)  # ends each `accept`
        self._listener.close()
