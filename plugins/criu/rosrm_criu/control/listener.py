"""The node's side of its control directory: what it is asked, and what it answers."""

from __future__ import annotations

import sys
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Final

from rosrm.errors import PortableError
from rosrm_criu.control.client import make_directory, remove_directory
from rosrm_criu.control.messages import (
    Request,
    State,
    Status,
    Want,
    edition_of_request,
    read_request,
    write_status,
)

#: Absences that are remembered: a request of theirs that comes late does nothing.
_REMEMBERED: Final = 1000
#: Seconds after which the status is written anew: those who clean /tmp take what nobody touches.
_FRESH: Final = 3600.0


class Listener:
    """Hears requests, each once, and says how the node stands.

    Args:
        directory: it is made where it does not exist. At the start of a process nothing of an
            earlier one counts.

    Raises:
        PortableError: it cannot be used, or others could write there.

    Attributes:
        status: as it was said last.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._over: deque[str] = deque(maxlen=_REMEMBERED)
        self._seen: Request | None = None
        self._edition: tuple[int, ...] = ()
        self._fault = ""
        self._said = 0.0
        self.status = Status(State.JOINING)
        make_directory(directory)

    def asked(self) -> Request | None:
        """What the node shall do now, as it stands; None: nothing new."""
        if time.monotonic() > self._said + _FRESH:
            self.say(self.status)
        request = self._read()
        if request is None or request == self._seen:
            return None
        self._seen = request
        if request.id in self._over:
            return None
        standing = Want.JOIN if self.status.state is State.RUNNING else Want.LEAVE
        if request.want is not standing:
            return request
        # It stands where it is wanted: called back before it left, or asked twice to leave.
        if request.want is Want.JOIN:
            self._over.append(request.id)
        self.say(Status(self.status.state, request.id))
        return None

    def say(self, status: Status) -> None:
        """Tell whoever looks. Who waits has a time-out, should it not be writable."""
        if self.status.request not in ("", status.request):
            self._over.append(self.status.request)
        self.status = status
        self._said = time.monotonic()
        try:
            write_status(self._directory, status)
        except OSError as error:
            self._complain(f"{self._directory} cannot be written: {error.strerror}")

    def enter(self, state: State, request: str = "") -> None:
        """Say the next state of an absence; its times so far stand."""
        self.say(replace(self.status, state=state, request=request or self.status.request))

    def done(self, status: Status) -> None:
        """Say that an absence is over, one way or another."""
        self._over.append(status.request)
        self.say(status)

    def close(self) -> None:
        """The process ends in good order: nobody is spoken to there any more."""
        remove_directory(self._directory)

    def _read(self) -> Request | None:
        """What is asked; None: nothing that was not read before.

        A node that is away looks often, and may be dumped meanwhile. What it has open then has to
        lie at the other host too, and this file does not.
        """
        edition = edition_of_request(self._directory)
        if edition == self._edition:
            return None
        try:
            found = read_request(self._directory)
        except PortableError as error:
            self._complain(str(error))
            return None
        self._edition = edition
        return found

    def _complain(self, fault: str) -> None:
        """Once, in the log of the process: there may be no ROS just now."""
        if fault != self._fault:
            self._fault = fault
            print(f"rosrm: {fault}", file=sys.stderr, flush=True)  # noqa: T201 - its log
