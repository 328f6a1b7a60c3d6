"""Sessions of browsers: a random id in a cookie stands for a token, which no cookie carries."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from rosrm import clocks

if TYPE_CHECKING:
    from rosrm_web.access import Access
    from rosrm_web.tokens import User

#: Seconds after which a browser has to give the token again.
LIFETIME: Final = 12 * 3600.0
#: Maximum number of sessions of one user; a further one ends the oldest.
MOST_OF_USER: Final = 32


class Sessions:
    """Sessions of this run of the gateway; another gateway, or the next run, knows none of them.

    A session ends with the token of its user. As with the token, the role is that of the file.

    Args:
        access: has the users whose tokens are valid.
        clock: monotonic seconds.
    """

    def __init__(self, access: Access, clock: Callable[[], float] = clocks.boot_time) -> None:
        self._access = access
        self._clock = clock
        #: Digest of each id to that of the token and the end; neither id nor token is kept.
        self._known: dict[bytes, tuple[bytes, float]] = {}

    def begin(self, user: User) -> str:
        """Return the id of a new session."""
        self._known = {
            key: known for key, known in self._known.items() if self._user(*known)
        }  # fmt: skip
        own = [key for key, (token, _) in self._known.items() if token == user.digest]
        for key in own[: max(0, len(own) + 1 - MOST_OF_USER)]:
            del self._known[key]
        number = secrets.token_urlsafe(32)
        self._known[_digest(number)] = user.digest, self._clock() + LIFETIME
        return number

    def user_of(self, number: str) -> User | None:
        """Return the user of a session; None: there is none, or it has ended."""
        known = self._known.get(_digest(number))
        return self._user(*known) if known is not None else None

    def _user(self, token: bytes, end: float) -> User | None:
        users = self._access.users if self._clock() < end else ()
        return next((user for user in users if user.digest == token), None)


def cookie_name(*, is_secure: bool, port: int) -> str:
    """Return the name of the cookie.

    Browsers accept `__Host-` only over HTTPS, for the whole host and no other. Without HTTPS they
    send a cookie to all ports of the host, so the name has the port: no gateway replaces the cookie
    of another one.
    """
    return "__Host-rosrm-session" if is_secure else f"rosrm-session-{port}"


def cookie_of(header: str, name: str) -> str:
    """Return the value of a cookie in a header, which may have any content; "": it is not there."""
    for part in header.split(";"):
        key, _, value = part.strip().partition("=")
        if key == name:
            return value.strip('"')
    return ""


def _digest(number: str) -> bytes:
    return hashlib.sha256(number.encode(errors="surrogateescape")).digest()
