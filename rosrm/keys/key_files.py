"""Key files: the cluster's secret and its grants at the master, one file for each principal.

The files that a master, slave or command uses are in the directory `key_home`. Files that other
users can read are refused, as ssh refuses them. A principal's file may have any name in ".key".
"""

from __future__ import annotations

import base64
import contextlib
import fcntl
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import quote

import yaml

from rosrm.errors import ConfigError
from rosrm.keys.cluster import ClusterSecret, PrincipalKey, own_grant
from rosrm.keys.derivation import KEY_BYTES
from rosrm.keys.roles import Grant, Principal, Role, principal_of
from rosrm.runtime import durable
from rosrm.runtime.private_files import (
    make_private_directory,
    make_safe_directory,
    open_own,
    open_private,
)
from rosrm.wording import reason_of

_T = TypeVar("_T")

#: File of the cluster's secret, on the master's machine alone.
CLUSTER_FILE: Final = "cluster.key"
#: File of the grants, in the same directory.
GRANTS_FILE: Final = "principals.yaml"

_LOCK_FILE: Final = "keys.lock"
_OTHERS: Final = 0o077
_LARGEST: Final = 1 << 20
#: The generation of a key is below this number.
_GENERATIONS: Final = 1 << 32
#: Fields of a grant, the only ones that an error message may show.
_PUBLIC: Final = frozenset({"principal", "role", "generation"})
_WARNING: Final = "# Secret: a reader of this file can act as its owner. Mode 0600.\n"


def key_home() -> Path:
    """Return the directory of this user's keys: ROSRM_KEYS, else `~/.config/rosrm`."""
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(os.environ.get("ROSRM_KEYS") or Path(base) / "rosrm")


# --- the cluster's secret ------------------------------------------------------------------


def read_secret(home: Path) -> ClusterSecret | None:
    """Return the cluster's secret; None if this directory has no `cluster.key`.

    Raises:
        ConfigError: the file is invalid, or others can read it.
    """
    path = home / CLUSTER_FILE
    fields = _read(path)
    return None if fields is None else ClusterSecret(_key_in(fields, "secret", path))


def make_secret(home: Path) -> ClusterSecret:
    """Return the cluster's secret; create it if this directory has none.

    Two masters that start at the same time get the same secret.

    Raises:
        ConfigError: the file is invalid, others can read it, or it cannot be written.
    """
    with _locked(home):
        return read_secret(home) or _create_secret(home)


def _create_secret(home: Path) -> ClusterSecret:
    secret = ClusterSecret(os.urandom(KEY_BYTES))
    _write_secret(home, secret)
    return secret


def _write_secret(home: Path, secret: ClusterSecret) -> None:
    _write(home / CLUSTER_FILE, {"secret": _text_of(secret.secret)})


def rotate(home: Path, directory: Path) -> list[Path]:
    """Replace the cluster's secret, and write new key files of all principals.

    Args:
        home: directory of this user's keys.
        directory: for the key files; created if it is missing.

    Returns:
        Paths of the key files, which are on the disk before the secret is replaced, and get their
        names after that.

    Raises:
        ConfigError: a file is invalid, others can read it, or it cannot be written. Then the former
            secret stays valid.
    """
    secret = ClusterSecret(os.urandom(KEY_BYTES))
    with _locked(home):
        files = {
            directory / f"{one.principal.kind}-{quote(one.principal.name, safe='@')}.key": one
            for one in read_grants(home)
        }
        with ExitStack() as written:
            with _former_keys_stay(f"the key files in {directory} are not"):
                try:
                    make_safe_directory(directory)
                except OSError as error:
                    raise ConfigError(f"{directory} cannot be used: {reason_of(error)}") from None
                replacements = [
                    written.enter_context(prepared_key(path, secret.key_of(grant)))
                    for path, grant in files.items()
                ]
                _write_secret(home, secret)
            for replace in replacements:
                replace()
    return list(files)


# --- grants --------------------------------------------------------------------------------


def read_grants(home: Path) -> list[Grant]:
    """Return the grants that are not revoked; [] if the file does not exist.

    Raises:
        ConfigError: the file is invalid, or others can read it.
    """
    return [grant for grant, revoked in _all_grants(home) if not revoked]


#: Writes a key for its receiver; yields what puts it in its place.
HandOut = Callable[[Grant], AbstractContextManager[Callable[[], None]]]


def _keep(_: Grant) -> AbstractContextManager[Callable[[], None]]:
    return nullcontext(lambda: None)


def add_grant(home: Path, principal: Principal, role: Role, hand_out: HandOut = _keep) -> Grant:
    """Give a principal a role and a new key; its former key becomes invalid.

    Args:
        home: directory of this user's keys.
        principal: that gets the key.
        role: of the principal.
        hand_out: writes the key for its receiver, before the former key becomes invalid; what it
            yields is called after that. It is entered without the lock, because an output can
            block.

    Raises:
        ConfigError: a file is invalid, others can read it, or it cannot be written. Then the former
            key stays valid.
    """
    import secrets  # noqa: PLC0415 - OpenSSL, which a slave does not need

    # The generation is random, because a counter would repeat that of a revoked key after the file
    # of the grants was lost or restored from a backup. Then that key would be valid again.
    grant = Grant(principal, role, 1 + secrets.randbelow(_GENERATIONS - 1))
    with ExitStack() as written:
        with _former_keys_stay(f"the new key of {principal} is not"):
            publish = written.enter_context(hand_out(grant))
            with _locked(home):
                others = [one for one in _all_grants(home) if one[0].principal != principal]
                _write_grants(home, [*others, (grant, False)])
        publish()
    return grant


@contextlib.contextmanager
def _former_keys_stay(and_new: str) -> Iterator[None]:
    """Extend an error before the change of the grants or of the secret by its consequence."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{error}. Former keys stay valid, and {and_new}") from None


def revoke(home: Path, principals: Collection[Principal]) -> None:
    """Revoke the keys of all given principals; revoke no key if an error is raised.

    Raises:
        ConfigError: a principal has no key, or the file is invalid, others can read the file, or
            the file cannot be written.
    """
    with _locked(home):
        entries = _all_grants(home)
        held = {grant.principal for grant, revoked in entries if not revoked}
        unknown = [str(one) for one in principals if one not in held]
        if unknown:
            raise ConfigError(
                f"no key of {', '.join(unknown)}; `rosrm key list` shows all. Nothing was revoked"
            )
        _write_grants(
            home, [(grant, gone or grant.principal in principals) for grant, gone in entries]
        )


def grants_version(home: Path) -> tuple[tuple[int, ...], ...]:
    """Return a value that changes whenever the grants or the cluster's secret change."""
    return tuple(_version(home / name) for name in (GRANTS_FILE, CLUSTER_FILE))


def _version(path: Path) -> tuple[int, ...]:
    try:
        facts = path.stat()
    except FileNotFoundError:
        return ()
    # The time of modification alone can be set, and is coarse on some file systems.
    return (facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns)


def _all_grants(home: Path) -> list[tuple[Grant, bool]]:
    path = home / GRANTS_FILE
    fields = _read(path) or {}
    rows = fields.get("principals", [])
    if not isinstance(rows, list):
        raise ConfigError(f"{path}: principals: must be a list")
    # Every value but `false` revokes a grant, such as the text "true" from a manual change.
    return [(_grant_in(row, path), row.get("revoked", False) is not False) for row in rows]


def _write_grants(home: Path, entries: list[tuple[Grant, bool]]) -> None:
    rows = [_row_of(grant) | ({"revoked": True} if gone else {}) for grant, gone in entries]
    _write(home / GRANTS_FILE, {"principals": rows})


# --- a principal's file ----------------------------------------------------------------------


def text_of(key: PrincipalKey) -> str:
    """Return the content of a principal's key file."""
    return _text(_fields_of(key))


def _fields_of(key: PrincipalKey) -> dict[str, Any]:
    return {**_row_of(key.grant), "key": _text_of(key.key), "master": _text_of(key.master)}


def write_key(path: Path, key: PrincipalKey) -> None:
    """Write a principal's key file; raises `ConfigError` as `prepared_key`."""
    with prepared_key(path, key) as replace:
        replace()


@contextlib.contextmanager
def prepared_key(path: Path, key: PrincipalKey) -> Iterator[Callable[[], None]]:
    """Write a principal's key file beside another one; yield what puts it in its place.

    Raises:
        ConfigError: the directory does not exist, or the file cannot be written.
    """
    try:
        path.parent.stat()  # a mistyped path is refused, not created
        make_safe_directory(path.parent)
    except FileNotFoundError:
        raise ConfigError(
            f"{path} cannot be written: there is no directory {path.parent}"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {reason_of(error)}") from None
    with _prepared(path, _fields_of(key)) as replace:
        yield replace


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
    """Return the key that a slave or command of this user uses; None if this user has no key.

    Args:
        kind: "host" or "user".
        name: name of the host; "": the only key file of this kind, whatever its name.
        home: directory of this user's keys.
        explicit: path of a key file; "": search `home`, then use the cluster's secret.

    Raises:
        ConfigError: a file is invalid, others can read it, or several files fit.
    """
    if explicit:
        return read_key(Path(explicit))
    found = {
        path: key for path in key_paths(home)
        if (key := read_key(path)).grant.principal.kind == kind
        and name in ("", key.grant.principal.name)
    }  # fmt: skip
    if len(found) > 1:
        names = ", ".join(f"{path.name} ({key.grant.principal})" for path, key in found.items())
        raise ConfigError(
            f"{home} has several key files for a {kind}: {names}; name the file to use in ROSRM_KEY"
        )
    if found:
        return next(iter(found.values()))
    secret = read_secret(home)
    if secret is None:
        return None
    principal = principal_of(f"{kind}:{name or user_name()}")
    return secret.key_of(own_grant(principal))


def user_name() -> str:
    """Return the account name of the user of this program."""
    try:
        import pwd  # noqa: PLC0415 - only where a key is derived

        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a user id without an account, as in containers
        return f"uid-{os.getuid()}"


def key_paths(home: Path) -> list[Path]:
    """Return the paths of the principals' key files in a directory."""
    return [path for path in sorted(home.glob("*.key")) if path.name != CLUSTER_FILE]


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
        shown = fields  # in a key file, `fields` also contains the key
        if isinstance(fields, dict):
            shown = {name: value for name, value in fields.items() if name in _PUBLIC}
        raise ConfigError(f"{path}: invalid entry {shown!r}: {error}") from None
    if (role is Role.HOST) is not (principal.kind == "host"):
        raise ConfigError(f"{path}: {principal} cannot have the role {role.value}")
    if not isinstance(generation, int) or not 1 <= generation < _GENERATIONS:
        last = _GENERATIONS - 1
        raise ConfigError(f"{path}: the generation of {principal} must be from 1 to {last}")
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
    """Return the fields of a file that only its owner can read; None if it does not exist."""
    try:
        descriptor, mode = open_own(str(path), os.O_RDONLY)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"the key file {path} cannot be used: {reason_of(error)}") from None
    with os.fdopen(descriptor, "rb") as file:
        if mode & _OTHERS:
            raise ConfigError(
                f"the key file {path} has mode {mode:04o}, so that others can read or change it; "
                f"run `chmod 600 {path}`. If others may have read it, replace the key: run `rosrm "
                f"key add` again on the machine of the master"
            )
        content = file.read(_LARGEST + 1)
    if len(content) > _LARGEST:  # a truncated file could lack `revoked: true`
        raise ConfigError(f"the key file {path} has more than {_LARGEST} bytes")
    try:
        fields = yaml.safe_load(content)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise ConfigError(f"{path} is no key file of rosrm")
    return fields


def _text(fields: Mapping[str, Any]) -> str:
    return _WARNING + yaml.safe_dump(dict(fields), sort_keys=False)


def _write(path: Path, fields: Mapping[str, Any]) -> None:
    """Replace a file durably, with mode 0600: a revoked key stays revoked after a loss of power."""
    with _prepared(path, fields) as replace:
        replace()


@contextlib.contextmanager
def _prepared(path: Path, fields: Mapping[str, Any]) -> Iterator[Callable[[], None]]:
    content = _text(fields).encode()
    if len(content) > _LARGEST:
        raise ConfigError(f"{path} cannot be written: it would have more than {_LARGEST} bytes")
    with ExitStack() as written:
        prepared = durable.prepared(str(path), content)
        replace = _writing(path, lambda: written.enter_context(prepared))
        yield lambda: _writing(path, replace)


def _writing(path: Path, write: Callable[[], _T]) -> _T:
    try:
        return write()
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {reason_of(error)}") from None


@contextlib.contextmanager
def _locked(home: Path) -> Iterator[None]:
    """Create the directory of keys if it is missing, and hold its lock.

    Without the lock, two commands at the same time could overwrite each other's grants.
    """
    try:
        make_private_directory(home)
        lock = open_private(str(home / _LOCK_FILE), os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise ConfigError(
            f"the directory of keys {home} cannot be used: {reason_of(error)}; ROSRM_KEYS can name "
            f"another directory"
        ) from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)
