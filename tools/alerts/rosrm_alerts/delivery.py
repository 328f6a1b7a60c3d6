"""Delivery of notices: a thread for each sink, with retries."""

from __future__ import annotations

import logging
import threading
from typing import Final

from rosrm import clocks, threads
from rosrm.errors import PluginError
from rosrm.extensions.guarded_sink import GuardedSink
from rosrm.extensions.sinks import NoticesRefused
from rosrm.wording import counted, duration
from rosrm_alerts.outbox import Outbox, OutboxError, Waiting

#: Seconds before the first retry, and the most between two retries; each wait doubles.
FIRST_RETRY: Final = 1.0
LONGEST_RETRY: Final = 300.0
#: Seconds after which a warning names a sink whose `send` has not returned.
PATIENCE: Final = 60.0

_log = logging.getLogger("rosrm.alerts")


class Delivery:
    """Delivers the notices of one sink, in order.

    Args:
        name: name of the sink in the file.
        sink: is closed at the end.
        batch: most notices in one call.
    """

    def __init__(
        self, name: str, sink: GuardedSink, outbox: Outbox, batch: int = 1,
        first_retry: float = FIRST_RETRY, patience: float = PATIENCE,
    ) -> None:  # fmt: skip
        self._name, self._sink, self._outbox, self._batch = name, sink, outbox, batch
        self._first_retry, self._patience = first_retry, patience
        self._sending_since: float | None = None
        self._sent: list[Waiting] = []  # taken by the sink, and still stored
        self._wake, self._stop = threading.Event(), threading.Event()
        # A daemon, because a sink that hangs must not keep the process alive.
        self._thread = threads.start(self._run, f"sink {name}", again=True)

    def notify(self) -> None:
        """Deliver new notices now."""
        self._wake.set()

    def look(self) -> None:
        """Warn once of a call of the sink that does not return."""
        since = self._sending_since
        if since is not None and clocks.boot_time() - since >= self._patience:
            self._sending_since = None
            _log.warning(
                "sink %s: send has not returned for %s; its notices wait",
                self._name, duration(self._patience),
            )  # fmt: skip

    def close(self, timeout: float) -> None:
        """Deliver what waits, for at most `timeout` seconds, and close the sink."""
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            _log.warning("sink %s: a delivery has not ended after %g s", self._name, timeout)

    def _run(self) -> None:
        retry = 0.0
        while True:
            delivered = self._deliver()
            if self._stop.is_set():
                break
            if delivered:
                retry = 0.0
                self._wake.wait()
                self._wake.clear()
            else:
                retry = min(max(retry * 2.0, self._first_retry), LONGEST_RETRY)
                _log.warning("sink %s: next attempt in %s", self._name, duration(retry))
                self._stop.wait(retry)
        self._sink.close()

    def _deliver(self) -> bool:
        """Deliver all that waits; return False if an attempt failed."""
        while self._remove_sent() and (waiting := self._outbox.waiting(self._name, self._batch)):
            notices = [one.notice for one in waiting]
            self._sending_since = clocks.boot_time()
            try:
                self._sink.send(notices)
            except NoticesRefused as refusal:
                many = counted(len(waiting), "notice")
                _log.error("sink %s: %s dropped: %s", self._name, many, refusal)
            except PluginError as fault:
                _log.warning("sink %s: %s", self._name, fault)
                return False
            finally:
                self._sending_since = None
            self._sent = waiting
        return not self._sent

    def _remove_sent(self) -> bool:
        """Remove the notices that the sink has taken; without that, none is sent again."""
        try:
            if self._sent:
                self._outbox.delivered(self._sent)
        except OutboxError as fault:
            _log.warning("sink %s: %s", self._name, fault)
            return False
        self._sent = []
        return True
