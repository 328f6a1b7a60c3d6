"""Users of a running gateway: their file is read again when it changes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from rosrm.errors import ConfigError
from rosrm_web.master_link import Busy
from rosrm_web.tokens import User, read_tokens

#: Maximum number of requests, streams and pages that one user has open.
MOST_OPEN: Final = 24
#: Seconds between two looks at the file.
PERIOD: Final = 1.0

_log = logging.getLogger("rosrm.web")


class Access:
    """The users, and the requests and pages that each of them has open.

    Args:
        users: users at the start.
        path: of the file with their tokens; None: there is no file.

    Attributes:
        users: users whose tokens are valid; (): everyone may read.
        trouble: why the changed file is not used; "": `users` are those of the file.
    """

    def __init__(self, users: tuple[User, ...] = (), path: Path | None = None) -> None:
        self.users = users
        self.trouble = ""
        self._path = path
        self._seen = _state(path)
        self._open: dict[object, tuple[User, Callable[[], object]]] = {}

    async def follow_file(self) -> None:
        """Check the file for changes every `PERIOD`, until the task is cancelled."""
        while self._path is not None:
            await asyncio.sleep(PERIOD)
            self.look(self._path)

    def look(self, path: Path) -> None:
        """Read the file again if it has changed; end the requests and pages of removed users.

        A user with another role or token is another user.

        An invalid file changes nothing.
        """
        state = _state(path)
        if state == self._seen:
            return
        self._seen = state
        try:
            self.users = read_tokens(path)
        except ConfigError as error:
            self.trouble = str(error)
            _log.error("tokens: the former tokens stay valid: %s", error)
            return
        self.trouble = ""
        _log.info("tokens: file read again: %d users", len(self.users))
        for user, end in list(self._open.values()):
            if user not in self.users:
                end()

    def check_room(self, user: User) -> None:
        """Refuse one more request or page of a user that leaves no room for others; raises `Busy`.

        Where no tokens are required, all requests count for one user.
        """
        if user in self.users and sum(one == user for one, _ in self._open.values()) >= MOST_OPEN:
            raise Busy(f"{user.name} has {MOST_OPEN} requests and pages open; close one first")

    @contextmanager
    def open_request(self, user: User) -> Iterator[None]:
        """Let `look` cancel the present task when the user's token is revoked."""
        task = asyncio.current_task()
        assert task is not None
        close = self.open(user, task.cancel)
        try:
            yield
        finally:
            close()

    def open(self, user: User, end: Callable[[], object]) -> Callable[[], None]:
        """Let `look` call `end` if the token is revoked; the returned function ends that."""
        key = object()
        self._open[key] = user, end

        def close() -> None:
            del self._open[key]

        return close


def _state(path: Path | None) -> tuple[int, ...]:
    """Return values that change with the file or its mode; (): there is no file."""
    with suppress(OSError):
        if path is not None:
            state = path.stat()
            return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns
    return ()
