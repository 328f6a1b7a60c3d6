"""Tokens of the users of the gateway, and their roles."""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, cast, get_args

from rosrm.errors import ConfigError
from rosrm_web.private_files import check_private

#: A viewer reads; an operator acts, too.
Role = Literal["viewer", "operator"]

#: Path of that form, which needs no token.
LOGIN: Final = "/login"

_ROLES: Final = get_args(Role)
_NAME: Final = re.compile(r"[A-Za-z0-9_.@-]{1,64}")
#: Characters that RFC 6750 allows; 24 of them cannot be guessed if they are random.
_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/-]{24,512}=*")


@dataclass(frozen=True)
class User:
    """A user of the gateway.

    Attributes:
        name: for the log.
        role: rights.
        digest: SHA-256 of the token.
    """

    name: str
    role: Role
    digest: bytes = field(default=b"", repr=False)


#: Everyone, where no tokens are required.
ANYONE: Final = User("anyone", "viewer")


def read_tokens(path: Path) -> tuple[User, ...]:
    """Return the users of a file with lines "ROLE NAME TOKEN".

    Empty lines, and lines that begin with #, are skipped. No message contains a token.

    Raises:
        ConfigError: the file cannot be read, others can read it, or a line is invalid.
    """
    check_private("--tokens", path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ConfigError(f"--tokens {path}: cannot be read: {error}") from None
    users: dict[str, User] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        user = _user(f"{path}:{number}", line.split())
        if user.name in users:
            raise ConfigError(f"{path}:{number}: the name {user.name!r} is there twice")
        users[user.name] = user
    if not users:
        raise ConfigError(f"--tokens {path}: it has no token; a line is `ROLE NAME TOKEN`")
    return tuple(users.values())


def _user(place: str, words: Sequence[str]) -> User:
    if len(words) != 3:
        raise ConfigError(f"{place}: `ROLE NAME TOKEN` is required, such as `operator ada TOKEN`")
    role, name, token = words
    if role not in _ROLES:
        raise ConfigError(f"{place}: the first word is a role: {' or '.join(_ROLES)}")
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{place}: a name has 1 to 64 letters, digits and the characters . _ @ -")
    if not _TOKEN.fullmatch(token):
        raise ConfigError(
            f"{place}: the token of {name} is too short, or has characters that HTTP does not "
            "allow; `openssl rand -hex 32` prints a good one"
        )
    return User(name, cast("Role", role), _digest(token))


def user_of(authorization: str, users: Sequence[User]) -> User | None:
    """Return the user of an Authorization header; None: the token is missing or wrong.

    The time of the comparison does not depend on the token.
    """
    scheme, _, token = authorization.partition(" ")
    if scheme.lower() != "bearer":
        return None
    digest = _digest(token.strip())
    found = [user for user in users if hmac.compare_digest(user.digest, digest)]
    return found[0] if found else None


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode()).digest()
