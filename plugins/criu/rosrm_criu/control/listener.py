"""The node's side of its control directory: reads requests and writes the status."""

from __future__ import annotations

import sys
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Final

from rosrm import clocks
from rosrm.errors import PortableError
from rosrm.wording import reason_of
from rosrm_criu.control.client import make_directory
from rosrm_criu.control.directory import remove_directory
from rosrm_criu.control.messages import (
    Request,
    State,
    Status,
    Want,
    edition_of_request,
    read_message,
    write_message,
)

#: Finished departures to remember; a late request of one of them has no effect.
_REMEMBERED: Final = 1000
#: Seconds until the status is written again: cleaners of /tmp remove files that stay untouched.
_FRESH: Final = 3600.0
#: Seconds until a status that could not be written is written again.
_RETRY: Final = 0.5


class Listener:
    """Reader of requests, each once, and writer of the node's status.

    Args:
        directory: created if missing. Files of an earlier process there are removed.

    Raises:
        PortableError: it cannot be used, or other users could write there.

    Attributes:
        status: the last one that was written.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._ended: deque[str] = deque(maxlen=_REMEMBERED)
        self._seen: Request | None = None
        self._edition: tuple[int, ...] = ()
        self._fault = ""
        self._next_report = 0.0
        self.status = Status(State.JOINING)
        make_directory(directory)

    def next_request(self) -> Request | None:
        """Return the request that the node has to act on now; None: there is no new one."""
        if clocks.boot_time() >= self._next_report:
            self.report(self.status)
        request = self._read()
        if request is None or request == self._seen:
            return None
        self._seen = request
        if request.id in self._ended:
            return None
        standing = Want.JOIN if self.status.state is State.RUNNING else Want.LEAVE
        if request.want is not standing:
            return request
        # The node is already in the requested state: withdrawn before it left, or requested twice.
        if request.want is Want.JOIN:
            self._ended.append(request.id)
        self.report(Status(self.status.state, request.id))
        return None

    def report(self, status: Status) -> None:
        """Write the status. If that fails, log it; `next_request` tries again."""
        if self.status.request not in ("", status.request):
            self._ended.append(self.status.request)
        self.status = status
        self._next_report = clocks.boot_time() + _FRESH
        try:
            write_message(self._directory, status)
        except OSError as error:
            self._next_report = clocks.boot_time() + _RETRY
            self._log(f"{self._directory} cannot be written: {reason_of(error)}")

    def enter(self, state: State, request: str = "") -> None:
        """Write the next state of a departure; its measured times are kept."""
        self.report(replace(self.status, state=state, request=request or self.status.request))

    def finish(self, status: Status) -> None:
        """Write the final status of a departure, successful or not."""
        self._ended.append(status.request)
        self.report(status)

    def close(self) -> None:
        """Remove the control directory at the regular end of the process."""
        remove_directory(self._directory)

    def _read(self) -> Request | None:
        """Return the request, if its file has changed since the last read; otherwise None.

        A node that is away polls often, and may be dumped at any moment. A file that is open then
        must exist on the destination too, and this one does not.
        """
        edition = edition_of_request(self._directory)
        if edition == self._edition:
            return None
        try:
            found = read_message(self._directory, Request)
        except PortableError as error:
            self._log(str(error))
            return None
        self._edition = edition
        return found

    def _log(self, fault: str) -> None:
        """Log a fault once to standard error, because rclpy's logging may be down."""
        if fault != self._fault:
            self._fault = fault
            print(f"rosrm: {fault}", file=sys.stderr, flush=True)  # noqa: T201 - its log
