"""Files of keys: the cluster's secret and its grants at the master, one file for each principal.

All lie in one directory, `key_home`, are readable by their owner alone, and are refused otherwise,
as ssh does. A principal's file may have any name that ends in ".key".
"""

from __future__ import annotations

import base64
import errno
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import yaml

from rosrm.errors import ConfigError
from rosrm.keys.cluster import ClusterSecret, PrincipalKey, own_grant
from rosrm.keys.derivation import KEY_BYTES
from rosrm.keys.roles import Grant, Principal, Role, principal_of

#: File of the cluster's secret, on the master's machine alone.
CLUSTER_FILE: Final = "cluster.key"
#: File of the grants, beside it.
GRANTS_FILE: Final = "principals.yaml"

_LARGEST: Final = 1 << 20
_WARNING: Final = "# Secret: whoever reads this file can act as its owner. Mode 0600.\n"


def key_home() -> Path:
    """Return the directory of this user's keys: ROSRM_KEYS, else `~/.config/rosrm`."""
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(os.environ.get("ROSRM_KEYS") or Path(base) / "rosrm")


# --- the cluster's secret ------------------------------------------------------------------


def read_secret(home: Path) -> ClusterSecret | None:
    """Return the cluster's secret; None: there is none in this directory.

    Raises:
        ConfigError: the file is invalid, or others can read it.
    """
    path = home / CLUSTER_FILE
    fields = _read(path)
    return None if fields is None else ClusterSecret(_key_in(fields, "secret", path))


def make_secret(home: Path) -> ClusterSecret:
    """Return the cluster's secret, drawn now if this directory has none.

    Two masters that start at once get the same one.
    """
    secret = ClusterSecret(os.urandom(KEY_BYTES))
    try:
        _write(home / CLUSTER_FILE, {"secret": _text_of(secret.secret)}, new=True)
    except FileExistsError:
        found = read_secret(home)
        if found is None:
            raise ConfigError(f"{home / CLUSTER_FILE} was removed at this moment") from None
        return found
    return secret


def rotate(home: Path, directory: Path) -> list[Path]:
    """Replace the cluster's secret, and write new key files of all principals.

    Args:
        home: directory of this user's keys.
        directory: for the key files; created if it is missing.

    Returns:
        The key files. They are written first, so that no principal is without a key.

    Raises:
        ConfigError: a file is invalid, or others can read it.
        OSError: a file cannot be written; the former secret is still valid.
    """
    secret = ClusterSecret(os.urandom(KEY_BYTES))
    written = []
    for grant in read_grants(home):
        path = directory / f"{grant.principal.kind}-{quote(grant.principal.name, safe='@')}.key"
        _write(path, _fields_of(secret.key_of(grant)))
        written.append(path)
    _write(home / CLUSTER_FILE, {"secret": _text_of(secret.secret)})
    return written


# --- grants --------------------------------------------------------------------------------


def read_grants(home: Path) -> list[Grant]:
    """Return the grants, revoked ones left out; [] without a file.

    Raises:
        ConfigError: the file is invalid, or others can read it.
    """
    return [grant for grant, revoked in _all_grants(home) if not revoked]


def add_grant(home: Path, principal: Principal, role: Role) -> Grant:
    """Give a principal a role and a new key; an earlier key of it ends.

    Raises:
        ConfigError: the file is invalid, or others can read it.
    """
    entries = _all_grants(home)
    newest = max((old.generation for old, _ in entries if old.principal == principal), default=0)
    grant = Grant(principal, role, newest + 1)
    others = [(old, revoked) for old, revoked in entries if old.principal != principal]
    _write_grants(home, [*others, (grant, False)])
    return grant


def revoke(home: Path, principal: Principal) -> bool:
    """End the key of a principal; False: it has none."""
    entries = _all_grants(home)
    if all(grant.principal != principal or gone for grant, gone in entries):
        return False
    _write_grants(home, [(grant, gone or grant.principal == principal) for grant, gone in entries])
    return True


def grants_version(home: Path) -> tuple[int, int]:
    """Return a value that changes whenever the grants change."""
    try:
        facts = (home / GRANTS_FILE).stat()
    except FileNotFoundError:
        return (0, 0)
    return (facts.st_mtime_ns, facts.st_ino)


def _all_grants(home: Path) -> list[tuple[Grant, bool]]:
    path = home / GRANTS_FILE
    fields = _read(path) or {}
    rows = fields.get("principals", [])
    if not isinstance(rows, list):
        raise ConfigError(f"{path}: principals: must be a list")
    return [(_grant_in(row, path), row.get("revoked") is True) for row in rows]


def _write_grants(home: Path, entries: list[tuple[Grant, bool]]) -> None:
    rows = [_row_of(grant) | ({"revoked": True} if gone else {}) for grant, gone in entries]
    _write(home / GRANTS_FILE, {"principals": rows})


# --- a principal's file ----------------------------------------------------------------------


def text_of(key: PrincipalKey) -> str:
    """Return the content of a principal's key file."""
    return _text(_fields_of(key))


def _fields_of(key: PrincipalKey) -> dict[str, Any]:
    return {**_row_of(key.grant), "key": _text_of(key.key), "master": _text_of(key.master)}


def read_key(path: Path) -> PrincipalKey:
    """Return the key in a principal's file.

    Raises:
        ConfigError: the file is missing or invalid, or others can read it.
    """
    fields = _read(path)
    if fields is None:
        raise ConfigError(f"the key file {path} does not exist")
    grant = _grant_in(fields, path)
    return PrincipalKey(grant, _key_in(fields, "key", path), _key_in(fields, "master", path))


def find_key(kind: str, name: str, home: Path, explicit: str = "") -> PrincipalKey | None:
    """Return the key with which a process of this user speaks; None: there is none.

    Args:
        kind: "host" or "user".
        name: of the host; for a user "" accepts the key of every user.
        home: directory of this user's keys.
        explicit: path of a key file; "": search `home`, then use the cluster's secret.

    Raises:
        ConfigError: a file is invalid, or there are keys of several users.
    """
    if explicit:
        return read_key(Path(explicit))
    found = [
        key for key in _keys_in(home)
        if key.grant.principal.kind == kind and name in ("", key.grant.principal.name)
    ]  # fmt: skip
    if len(found) > 1:
        names = ", ".join(str(key.grant.principal) for key in found)
        raise ConfigError(
            f"{home} has several keys for this: {names}; name the file of one in ROSRM_KEY"
        )
    if found:
        return found[0]
    secret = read_secret(home)
    if secret is None:
        return None
    principal = principal_of(f"{kind}:{name or _user()}")
    return secret.key_of(own_grant(principal))


def _user() -> str:
    try:
        import pwd  # noqa: PLC0415 - only where a key is derived

        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a user id without an account, as in containers
        return f"uid-{os.getuid()}"


def _keys_in(home: Path) -> Iterator[PrincipalKey]:
    for path in sorted(home.glob("*.key")):
        if path.name != CLUSTER_FILE:
            yield read_key(path)


# --- fields ----------------------------------------------------------------------------------


def _row_of(grant: Grant) -> dict[str, Any]:
    return {
        "principal": str(grant.principal),
        "role": grant.role.value,
        "generation": grant.generation,
    }


def _grant_in(fields: Any, path: Path) -> Grant:
    try:
        principal = principal_of(str(fields["principal"]))
        role = Role(fields["role"])
        generation = fields["generation"]
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise ConfigError(f"{path}: invalid entry {fields!r}: {error}") from None
    if (role is Role.HOST) is not (principal.kind == "host"):
        raise ConfigError(f"{path}: {principal} cannot have the role {role.value}")
    if not isinstance(generation, int) or not 1 <= generation < 1 << 32:
        raise ConfigError(f"{path}: the generation of {principal} must be from 1 to {2**32 - 1}")
    return Grant(principal, role, generation)


def _key_in(fields: Mapping[str, Any], name: str, path: Path) -> bytes:
    try:
        key = base64.b64decode(str(fields[name]), validate=True)
    except (KeyError, ValueError):
        key = b""
    if len(key) != KEY_BYTES:
        raise ConfigError(f"{path}: `{name}` must be {KEY_BYTES} bytes in base64")
    return key


def _text_of(key: bytes) -> str:
    return base64.b64encode(key).decode()


# --- reading and writing ---------------------------------------------------------------------


def _read(path: Path) -> dict[str, Any] | None:
    """Return the fields of a file that only its owner can read; None: there is no file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return None
    except OSError as error:
        why = "it is a symbolic link" if error.errno == errno.ELOOP else error.strerror
        raise ConfigError(f"the key file {path} cannot be read: {why}") from None
    with os.fdopen(descriptor, "rb") as file:
        _check_private(path, os.fstat(descriptor))
        content = file.read(_LARGEST)
    try:
        fields = yaml.safe_load(content)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise ConfigError(f"{path} is no key file of rosrm")
    return fields


def _check_private(path: Path, facts: os.stat_result) -> None:
    if not stat.S_ISREG(facts.st_mode):
        raise ConfigError(f"{path} is no regular file")
    if facts.st_uid != os.getuid():
        raise ConfigError(f"the key file {path} belongs to user {facts.st_uid}; make it your own")
    if facts.st_mode & 0o077:
        raise ConfigError(
            f"the key file {path} has mode {stat.S_IMODE(facts.st_mode):04o}, so that others can "
            f"read it; run `chmod 600 {path}`. If others may have read it, replace the key: `rosrm "
            f"key add` again at the master"
        )


def _text(fields: Mapping[str, Any]) -> str:
    return _WARNING + yaml.safe_dump(dict(fields), sort_keys=False)


def _write(path: Path, fields: Mapping[str, Any], *, new: bool = False) -> None:
    """Write a file that only its owner can read, whole or not at all.

    Raises:
        FileExistsError: the file exists, and it was to be a new one.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.{os.urandom(4).hex()}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(_text(fields))
            file.flush()
            os.fsync(file.fileno())
        if new:
            os.link(draft, path)
        else:
            draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
