"""Key files: their owners, modes and content."""

from __future__ import annotations

import base64
import errno
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rosrm.errors import ConfigError
from rosrm.keys import key_files
from rosrm.keys.cluster import OWN, Principals
from rosrm.keys.roles import Principal, Role, principal_of
from rosrm.keys.sealing import Opener, Sealer

ROBOT, ADA = Principal("host", "robot-1"), Principal("user", "ada")


def test_the_secret_is_created_once_and_only_its_owner_can_read_it(tmp_path: Path) -> None:
    """Many processes that start at once share one secret, in a file of mode 0600."""
    home = tmp_path / "keys"
    with ThreadPoolExecutor(8) as pool:
        secrets = set(pool.map(lambda _: key_files.make_secret(home).secret, range(32)))
    assert len(secrets) == 1
    assert {path.name for path in home.iterdir()} == {key_files.CLUSTER_FILE, "keys.lock"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in home.iterdir()} == {0o600}
    assert stat.S_IMODE(home.stat().st_mode) == 0o700


def test_grants_of_commands_at_the_same_time_are_all_kept(tmp_path: Path) -> None:
    """Each command reads and writes the whole file, one after the other."""
    names = [Principal("host", f"robot-{number}") for number in range(16)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda one: key_files.add_grant(tmp_path, one, Role.HOST), names))
    assert {grant.principal for grant in key_files.read_grants(tmp_path)} == set(names)


def test_each_change_of_grants_or_secret_changes_their_version(tmp_path: Path) -> None:
    """A running master compares the version, and reads the files again after a change."""
    changes = [
        lambda: key_files.make_secret(tmp_path),
        lambda: key_files.add_grant(tmp_path, ROBOT, Role.HOST),
        lambda: key_files.rotate(tmp_path, tmp_path / "new"),
        lambda: key_files.revoke(tmp_path, [ROBOT]),
    ]
    seen = {key_files.grants_version(tmp_path)}
    for change in changes:
        change()
        seen.add(key_files.grants_version(tmp_path))
    assert len(seen) == 1 + len(changes)


def test_a_file_of_the_same_time_is_another_version(tmp_path: Path) -> None:
    """A copy of a backup with `cp -p` or `rsync -a` has the time of the original."""
    key_files.add_grant(tmp_path, ROBOT, Role.HOST)
    path, before = tmp_path / key_files.GRANTS_FILE, key_files.grants_version(tmp_path)
    times = path.stat()
    path.write_text(path.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert key_files.grants_version(tmp_path) != before


def test_a_full_disk_keeps_the_former_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rotation that fails does not end the keys that are in use."""
    secret = key_files.make_secret(tmp_path)
    key_files.add_grant(tmp_path, ROBOT, Role.HOST)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(ConfigError, match=r"robot-1\.key cannot be written: No space left"):
            key_files.rotate(tmp_path, tmp_path / "new")
    assert key_files.read_secret(tmp_path) == secret
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize("fault", ["a file", "a link"])
def test_a_directory_of_keys_that_cannot_be_used_is_refused(tmp_path: Path, fault: str) -> None:
    """The message names the variable by which another one is chosen."""
    home = tmp_path / "keys"
    if fault == "a file":
        home.touch()
    else:
        home.symlink_to(tmp_path)
    with pytest.raises(ConfigError, match=r"keys cannot be used: .*ROSRM_KEYS"):
        key_files.make_secret(home)


def test_a_key_file_is_valid_until_its_grant_is_revoked(tmp_path: Path) -> None:
    """A new key ends the former one."""
    secret = key_files.make_secret(tmp_path)
    first = key_files.add_grant(tmp_path, ROBOT, Role.HOST)
    path = tmp_path / "robot-1.key"
    key_files.write_key(path, secret.key_of(first))
    held = key_files.read_key(path)
    assert held == secret.key_of(first)
    known = Principals(key_files.read_grants(tmp_path))
    assert known.valid_grant(ROBOT, held.grant.generation) == held.grant
    before = key_files.grants_version(tmp_path)
    second = key_files.add_grant(tmp_path, ROBOT, Role.HOST)
    assert key_files.grants_version(tmp_path) != before
    valid = Principals(key_files.read_grants(tmp_path))
    assert valid.valid_grant(ROBOT, first.generation) is None
    assert valid.valid_grant(ROBOT, second.generation) == second
    key_files.revoke(tmp_path, [ROBOT])
    with pytest.raises(ConfigError, match="no key of host:robot-1"):
        key_files.revoke(tmp_path, [ROBOT])
    assert key_files.read_grants(tmp_path) == []


@pytest.mark.parametrize("fault", ["lost", "from a backup"])
def test_a_revoked_key_stays_void_whatever_happens_to_the_grants(tmp_path: Path, fault) -> None:
    """A new key differs from those that a lost, or a newer, file of the grants had revoked."""
    grants = tmp_path / key_files.GRANTS_FILE
    stolen = [key_files.add_grant(tmp_path, ROBOT, Role.HOST)]
    backup = grants.read_bytes()
    stolen.append(key_files.add_grant(tmp_path, ROBOT, Role.HOST))
    key_files.revoke(tmp_path, [ROBOT])
    grants.unlink()
    if fault == "from a backup":
        grants.touch(mode=0o600)
        grants.write_bytes(backup)
    assert key_files.add_grant(tmp_path, ROBOT, Role.HOST) not in stolen


def test_a_process_finds_its_own_key(tmp_path: Path) -> None:
    """The file of its principal, of any name; else a key of the cluster's secret; else none."""
    assert key_files.find_key("host", "robot-1", tmp_path) is None
    secret = key_files.make_secret(tmp_path)
    own = key_files.find_key("host", "robot-1", tmp_path)
    assert own is not None
    assert (own.grant.principal, own.grant.generation) == (ROBOT, OWN)
    assert Principals().valid_grant(ROBOT, OWN) == own.grant
    assert secret.key_of(own.grant) == own
    key = secret.key_of(key_files.add_grant(tmp_path, ROBOT, Role.HOST))
    path = tmp_path / "any name.key"
    key_files.write_key(path, key)
    assert key_files.find_key("host", "robot-1", tmp_path) == key
    assert key_files.find_key("user", "", tmp_path, explicit=str(path)) == key
    me = key_files.find_key("user", "", tmp_path)
    assert me is not None
    assert me.grant.role is Role.OPERATOR


def test_keys_of_two_users_are_refused_without_a_choice(tmp_path: Path) -> None:
    """The message names both files and the variable that chooses."""
    secret = key_files.make_secret(tmp_path)
    for name in ("ada", "bob"):
        grant = key_files.add_grant(tmp_path, principal_of(f"user:{name}"), Role.VIEWER)
        key_files.write_key(tmp_path / f"{name}.key", secret.key_of(grant))
    named = r"ada\.key \(user:ada\), bob\.key \(user:bob\); .*ROSRM_KEY"
    with pytest.raises(ConfigError, match=named):
        key_files.find_key("user", "", tmp_path)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o644, 0o660])
def test_a_file_that_others_can_open_is_refused(tmp_path: Path, mode: int) -> None:
    """As by ssh; the message names the remedy."""
    key_files.make_secret(tmp_path)
    path = tmp_path / key_files.CLUSTER_FILE
    path.chmod(mode)
    with pytest.raises(ConfigError, match=rf"mode {mode:04o}.*chmod 600"):
        key_files.read_secret(tmp_path)


def test_a_link_a_pipe_and_a_file_of_another_user_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No link is followed, and opening a pipe does not block."""
    key_files.make_secret(tmp_path)
    path = tmp_path / key_files.CLUSTER_FILE
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
        with pytest.raises(ConfigError, match="belongs to user"):
            key_files.read_secret(tmp_path)
    moved = path.rename(tmp_path / "moved")
    path.symlink_to(moved)
    with pytest.raises(ConfigError, match="symbolic link"):
        key_files.read_secret(tmp_path)
    path.unlink()
    os.mkfifo(path, 0o600)
    with pytest.raises(ConfigError, match="no regular file"):
        key_files.read_secret(tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        "", "- 1", "{", "\x00", "[" * 5000, "secret: 1", "secret: AAAA", "secret: é",
        "other: " + "A" * 44,
    ],
)  # fmt: skip
def test_an_invalid_secret_is_refused(tmp_path: Path, content: str) -> None:
    """The error is a `ConfigError`."""
    path = tmp_path / key_files.CLUSTER_FILE
    path.touch(mode=0o600)
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"cluster\.key"):
        key_files.read_secret(tmp_path)


@pytest.mark.parametrize("value", ["true", "yes", "'true'", "1", "2026-11-23", ""])
def test_a_grant_with_any_mark_is_revoked(tmp_path: Path, value: str) -> None:
    """Operators edit the file, too; only `false` leaves a grant valid."""
    path = tmp_path / key_files.GRANTS_FILE
    path.touch(mode=0o600)
    row = "principal: user:a, role: viewer, generation: 1, revoked:"
    path.write_text(f"principals: [{{{row} {value}}}, {{{row} false}}]")
    assert len(key_files.read_grants(tmp_path)) == 1


def test_a_file_is_read_whole_or_not_at_all(tmp_path: Path, monkeypatch) -> None:
    """A grant without its last line would no longer be revoked."""
    key_files.add_grant(tmp_path, ADA, Role.VIEWER)
    key_files.revoke(tmp_path, [ADA])
    whole = (tmp_path / key_files.GRANTS_FILE).read_bytes()
    monkeypatch.setattr(key_files, "_LARGEST", whole.index(b"  revoked"))
    with pytest.raises(ConfigError, match="has more than"):
        key_files.read_grants(tmp_path)
    monkeypatch.setattr(key_files, "_LARGEST", len(whole))
    with pytest.raises(ConfigError, match=r"cannot be written: .* more than"):
        key_files.add_grant(tmp_path, ROBOT, Role.HOST)
    assert (tmp_path / key_files.GRANTS_FILE).read_bytes() == whole


def test_no_error_or_repr_shows_a_key(tmp_path: Path) -> None:
    """A slave logs the error about its key file, and logs have more readers than key files."""
    secret = key_files.make_secret(tmp_path)
    held = secret.key_of(key_files.add_grant(tmp_path, ROBOT, Role.HOST))
    path = tmp_path / "robot-1.key"
    key_files.write_key(path, held)
    text = path.read_text()
    path.write_text(text.replace("role: host", "role: robot"))
    with pytest.raises(ConfigError, match="'robot' is not a valid Role") as refused:
        key_files.read_key(path)
    assert "host:robot-1" in str(refused.value)
    assert base64.b64encode(held.key).decode() not in str(refused.value)
    shown = repr((held, Sealer(held.key), Opener(held.key)))
    assert repr(held.key)[2:-1] not in shown


@pytest.mark.parametrize(
    "row",
    [
        "1", "{}", "{principal: host:a, role: operator, generation: 1}",
        "{principal: user:a, role: host, generation: 1}",
        "{principal: user:a, role: root, generation: 1}",
        "{principal: user:a, role: viewer, generation: 0}",
        "{principal: user:a, role: viewer, generation: x}",
        "{principal: user:a, role: [viewer], generation: 1}",
    ],
)  # fmt: skip
def test_an_invalid_grant_is_refused(tmp_path: Path, row: str) -> None:
    """A key of generation 0 cannot be granted, and a host has no role of users."""
    path = tmp_path / key_files.GRANTS_FILE
    path.touch(mode=0o600)
    path.write_text(f"principals: [{row}]")
    with pytest.raises(ConfigError, match=r"principals\.yaml"):
        key_files.read_grants(tmp_path)


@pytest.mark.parametrize("change", ["add", "rotate"])
def test_a_change_that_cannot_be_stored_leaves_the_key_files_in_use(tmp_path, monkeypatch, change):
    """Also where the new files replace those in use, a full disk leaves them valid."""
    secret, principal = key_files.make_secret(tmp_path), principal_of("host:a")
    path = tmp_path / "host-a.key"

    def add() -> None:
        key_files.add_grant(
            tmp_path, principal, Role.HOST,
            lambda grant: key_files.prepared_key(path, secret.key_of(grant)),
        )  # fmt: skip

    def is_valid() -> bool:
        key = key_files.read_key(path)
        (grant,) = key_files.read_grants(tmp_path)
        return key == key_files.read_secret(tmp_path).key_of(grant)

    add()
    with monkeypatch.context() as patch:
        stored, right = {"add": "principals.yaml", "rotate": "cluster.key"}[change], os.replace

        def full(source, target, **where) -> None:
            if target.endswith(stored):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            right(source, target, **where)

        patch.setattr(os, "replace", full)
        with pytest.raises(ConfigError, match="Former keys stay valid"):
            add() if change == "add" else key_files.rotate(tmp_path, tmp_path)
    assert is_valid()
    assert not list(tmp_path.glob("*.new"))
    add() if change == "add" else key_files.rotate(tmp_path, tmp_path)
    assert is_valid()
