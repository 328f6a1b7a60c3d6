"""Commands `rosrm key`: the cluster's secret, keys of hosts and users, and their check."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.keys import key_files
from rosrm.keys.cluster import ClusterSecret

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs files of another user")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Use an empty directory of keys; the host's name is `desk`."""
    for variable in ("ROSRM_KEY", "ROSRM_SECURITY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("ROSRM_KEYS", str(tmp_path / "keys"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))  # it may have a host's name
    monkeypatch.setattr("socket.gethostname", lambda: "desk")
    return tmp_path / "keys"


@pytest.fixture
def secret(rosrm, home):
    """Make the directory of keys that of a master."""
    assert rosrm("key", "init").code == 0
    return key_files.read_secret(home)


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


def listed(rosrm):
    """Return principals and roles of the rows of `rosrm key list`; each has the key's number."""
    lines = [line.split() for line in rosrm("key", "list").out.splitlines()]
    rows = [tuple(words) for words in lines if ":" in words[0]]
    assert all(int(number) for _, _, number in rows)
    return [(principal, role) for principal, role, _ in rows]


# --- init, add, list --------------------------------------------------------------------------


def test_the_secret_is_created_once(rosrm, home):
    path = home / "cluster.key"
    assert rosrm("key", "init").out == f"{path}: created\n"
    before = path.read_bytes()
    assert rosrm("key", "init").out == f"{path}: exists already\n"
    assert path.read_bytes() == before
    assert (mode_of(path), mode_of(home)) == (0o600, 0o700)


@pytest.mark.parametrize(
    "words",
    [("add", "host:a"), ("list",), ("revoke", "host:a"), ("rotate", "--out", "new")],
)  # fmt: skip
def test_a_command_of_the_master_refuses_another_machine(rosrm, home, words):
    result = rosrm("key", *words)
    assert (result.code, result.out) == (2, "")
    assert result.err == (
        f"rosrm: there is no {home}/cluster.key: run this command on the master's machine as "
        "the master's user, or create the file with `rosrm key init`\n"
    )
    assert not home.exists()


def test_a_new_key_has_the_role_of_the_present_one(rosrm, secret):
    """Otherwise a viewer could submit processes after its key was replaced."""
    for words in (("--role", "viewer"), (), ("--role", "operator"), ()):
        has_key = bool(listed(rosrm))
        said = rosrm("key", "add", "user:ada", *words).err
        assert ("its former key is no longer valid" in said) is has_key
    assert listed(rosrm) == [("user:ada", "operator")]
    assert rosrm("key", "revoke", "user:ada").code == 0
    assert rosrm("key", "add", "user:ada").code == 0
    assert listed(rosrm) == [("user:ada", "submitter")]


@pytest.mark.parametrize(
    ("words", "principal", "role"),
    [
        (("host:robot-1",), "host:robot-1", "host"),
        (("user:ada",), "user:ada", "submitter"),
        (("user:ada", "--role", "viewer"), "user:ada", "viewer"),
        (("user:ada@desk", "--role", "operator"), "user:ada@desk", "operator"),
    ],
)
def test_a_new_key_is_written_to_the_standard_output(
    rosrm, secret, tmp_path, words, principal, role
):
    result = rosrm("key", "add", *words)
    assert result.code == 0
    assert result.err == (
        f"rosrm: {principal} has a new key (role {role}). Copy the file to ~/.config/rosrm/ of the "
        "user that will use it, with mode 0600\n"
    )
    path = tmp_path / "some.key"
    path.touch(mode=0o600)
    path.write_text(result.out)
    key = key_files.read_key(path)
    assert (str(key.grant.principal), key.grant.role.value) == (principal, role)
    assert key == secret.key_of(key.grant)
    assert listed(rosrm) == [(principal, role)]


def test_a_second_key_replaces_the_first(rosrm, secret):
    rosrm("key", "add", "user:ada", "--role", "viewer")
    rosrm("key", "add", "host:robot-1")
    rosrm("key", "add", "user:ada", "--role", "operator")
    assert sorted(listed(rosrm)) == [("host:robot-1", "host"), ("user:ada", "operator")]


@pytest.mark.parametrize("name", ["robot-1", "host:", "host:a b", "group:x", "user:é", ":a", ""])
@pytest.mark.parametrize("command", ["add", "revoke"])
def test_a_wrong_name_is_refused(rosrm, secret, command, name):
    result = rosrm("key", command, name)
    assert (result.code, result.out) == (2, "")
    assert result.err == (
        f"rosrm: {name!r} names no principal; write host:NAME or user:NAME, with a name of 1 to "
        "128 letters, digits and characters of _ . ~ / @ -\n"
    )
    assert listed(rosrm) == []


@pytest.mark.parametrize(
    ("principal", "role", "allowed"),
    [
        ("host:a", "operator", "host"), ("user:a", "host", "viewer, submitter, operator"),
        ("user:a", "root", "viewer, submitter, operator"),
        ("user:a", "Viewer", "viewer, submitter, operator"),
    ],
)  # fmt: skip
def test_a_wrong_role_is_refused_with_the_allowed_ones(rosrm, secret, principal, role, allowed):
    result = rosrm("key", "add", principal, "--role", role)
    assert (result.code, result.out) == (2, "")
    assert result.err == f"rosrm: {principal} cannot have the role {role!r}; allowed: {allowed}\n"
    assert listed(rosrm) == []


def test_the_file_behind_the_standard_output_becomes_private(home, secret, tmp_path):
    """The shell creates the file with mode 0644 before the command starts."""
    path = tmp_path / "robot-1.key"
    with path.open("wb") as output:
        path.chmod(0o644)
        subprocess.run(
            [sys.executable, "-m", "rosrm.cli", "key", "add", "host:robot-1"],
            stdout=output, stderr=subprocess.DEVNULL, check=True,
        )  # fmt: skip
    assert mode_of(path) == 0o600
    assert str(key_files.read_key(path).grant.principal) == "host:robot-1"


def test_an_output_file_is_private_from_its_beginning(rosrm, secret, tmp_path):
    """An earlier file with another mode is replaced."""
    path = tmp_path / "ada.key"
    assert rosrm("key", "add", "user:ada", "--out", path).out == ""
    former = key_files.read_key(path)
    path.chmod(0o644)
    assert rosrm("key", "add", "user:ada", "--out", path).code == 0
    assert mode_of(path) == 0o600
    assert key_files.read_key(path) != former


def unwritable(tmp_path, fault):
    """Return a path that cannot be written, and the reason."""
    if fault == "no directory":
        folder = tmp_path / "missing"
        return folder / "ada.key", f"there is no directory {folder}"
    (folder := tmp_path / "others").mkdir()
    folder.chmod(0o777)
    return folder / "ada.key", (
        f"{folder} is writable for all users, who could replace it (`chmod o-w {folder}`)"
    )


@pytest.mark.parametrize("fault", ["no directory", "of others"])
def test_a_key_that_cannot_be_written_leaves_the_former_one_valid(rosrm, home, tmp_path, fault):
    """Otherwise the principal would have no key at all."""
    rosrm("key", "init")
    rosrm("key", "add", "user:ada", "--role", "viewer")
    before = key_files.read_grants(home)
    path, reason = unwritable(tmp_path, fault)
    result = rosrm("key", "add", "user:ada", "--role", "operator", "--out", path)
    assert (result.code, result.out) == (2, "")
    assert result.err == (
        f"rosrm: {path} cannot be written: {reason}. Former keys stay valid, and the new key of "
        "user:ada is not\n"
    )
    assert key_files.read_grants(home) == before
    assert not (tmp_path / "missing").exists()


def test_a_key_that_the_output_does_not_take_leaves_the_former_one_valid(rosrm, home, secret):
    """The output can be a file on a full disk."""
    rosrm("key", "add", "user:ada")
    before = key_files.read_grants(home)
    with Path("/dev/full").open("wb") as output:
        done = subprocess.run(
            [sys.executable, "-m", "rosrm.cli", "key", "add", "user:ada"],
            stdout=output, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode != 0
    assert "has a new key" not in done.stderr
    assert "No space left on device" in done.stderr
    assert key_files.read_grants(home) == before


def test_a_rotation_into_a_directory_of_others_ends_no_key(rosrm, home, secret, tmp_path):
    rosrm("key", "add", "user:ada")
    path, reason = unwritable(tmp_path, "of others")
    result = rosrm("key", "rotate", "--out", path.parent)
    assert (result.code, result.out) == (2, "")
    assert result.err == (
        f"rosrm: {path.parent} cannot be used: {reason}. Former keys stay valid, and the key files "
        f"in {path.parent} are not\n"
    )
    assert key_files.read_secret(home) == secret


# --- revoke, rotate ---------------------------------------------------------------------------


def test_revoked_keys_leave_the_list(rosrm, secret):
    for name in ("host:a", "host:b", "user:c"):
        rosrm("key", "add", name)
    assert rosrm("key", "revoke", "host:a", "user:c").out == "revoked: host:a, user:c\n"
    assert listed(rosrm) == [("host:b", "host")]
    rosrm("key", "add", "host:a")
    assert ("host:a", "host") in listed(rosrm)


def test_an_unknown_name_revokes_nothing(rosrm, secret):
    rosrm("key", "add", "host:a")
    result = rosrm("key", "revoke", "host:a", "host:b")
    assert (result.code, result.out) == (2, "")
    assert result.err == (
        "rosrm: no key of host:b; `rosrm key list` shows all. Nothing was revoked\n"
    )
    assert listed(rosrm) == [("host:a", "host")]


def test_a_rotation_writes_new_files_of_all_that_have_a_key(rosrm, home, secret, tmp_path):
    for name in ("host:a", "user:ada@desk", "host:b/c", "host:gone"):
        rosrm("key", "add", name)
    rosrm("key", "revoke", "host:gone")
    result = rosrm("key", "rotate", "--out", tmp_path / "new")
    assert result.out == f"created a new secret; wrote 3 key files to {tmp_path}/new\n"
    changed = key_files.read_secret(home)
    assert changed != secret
    files = sorted((tmp_path / "new").iterdir())
    assert [path.name for path in files] == ["host-a.key", "host-b%2Fc.key", "user-ada@desk.key"]
    for path in files:
        key = key_files.read_key(path)
        assert key == changed.key_of(key.grant)


# --- files that are refused -------------------------------------------------------------------


def spoil(path, fault):
    """Give a key file a fault, and return the text of its refusal."""
    if fault == "mode":
        path.chmod(0o644)
        return (
            f"the key file {path} has mode 0644, so that others can read or change it; run `chmod "
            f"600 {path}`. If others may have read it, replace the key: run `rosrm key add` again "
            "on the machine of the master"
        )
    if fault == "owner":
        os.chown(path, 12345, -1)
        return (
            f"the key file {path} cannot be used: it belongs to user 12345, and this is user "
            f"{os.geteuid()}"
        )
    path.rename(path.with_name("elsewhere"))
    path.symlink_to(path.with_name("elsewhere"))
    return f"the key file {path} cannot be used: it is a symbolic link"


FAULTS = ["mode", "link", pytest.param("owner", marks=as_root)]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["cluster.key", "principals.yaml"])
def test_files_of_the_master_that_are_not_private_are_refused(rosrm, home, secret, name, fault):
    rosrm("key", "add", "host:a")
    before = (home / "principals.yaml").read_bytes()
    text = spoil(home / name, fault)
    for words in (("add", "host:b"), ("list",), ("rotate", "--out", home / "new")):
        result = rosrm("key", *words)
        assert (result.code, result.out, result.err) == (2, "", f"rosrm: {text}\n")
    assert (home / "principals.yaml").read_bytes() == before
    check = rosrm("key", "check")
    assert check.code == 1
    assert f"problem        {text}\n" in check.out


@pytest.mark.parametrize("fault", FAULTS)
def test_a_key_file_that_is_not_private_is_refused(rosrm, home, secret, fault):
    path = home / "ada.key"
    rosrm("key", "add", "user:ada", "--out", path)
    text = spoil(path, fault)
    result = rosrm("key", "check", path)
    assert (result.code, result.out, result.err) == (2, "", f"rosrm: {text}\n")
    result = rosrm("key", "check")
    assert result.code == 1
    assert result.out.count(text) == 1


# --- check ------------------------------------------------------------------------------------


def facts(result):
    """Return the rows of `rosrm key check` by their labels."""
    found: dict[str, list[str]] = {}
    for line in result.out.splitlines():
        found.setdefault(line[:15].strip(), []).append(line[15:])
    return found


def test_the_user_of_the_master_has_all_rights_without_a_key_file(rosrm, home, secret):
    result = rosrm("key", "check")
    shown = facts(result)
    assert result.code == 0
    (commands,) = shown["commands"]
    assert commands.startswith("user:")
    assert commands.endswith(", role operator, from cluster.key")
    assert shown["slave"] == ["host:desk, role host, from cluster.key"]
    assert shown["cluster.key"] == ["here: all rights in the cluster"]
    assert shown["not protected"] == [
        "topics and services of the applications",
        "names, sizes and times of rosrm's messages",
        "delivery: flooding and forged packets of DDS can delay messages",
    ]
    assert "problem" not in shown


def test_a_user_without_a_key_gets_a_remedy(rosrm, home):
    result = rosrm("key", "check")
    shown = facts(result)
    assert result.code == 1
    assert (shown["commands"], shown["slave"]) == (["no key"], ["no key"])
    assert shown["cluster.key"] == ["not here: no rights but those of its keys"]
    (problem,) = shown["problem"]
    assert problem.startswith(f"this user has no key. Copy a key file of `rosrm key add` to {home}")


@pytest.fixture
def robot(home):
    """Make the directory of keys that of a robot, with the keys of its host and a viewer."""
    secret = ClusterSecret(bytes(32))
    home.mkdir(mode=0o700)
    for name, row in (("robot-1", "host"), ("ada", "viewer")):
        kind = "host" if row == "host" else "user"
        grant = key_files._grant_in(
            {"principal": f"{kind}:{name}", "role": row, "generation": 2}, Path("test")
        )
        key_files.write_key(home / f"{name}.key", secret.key_of(grant))
    return home


def test_a_robot_uses_its_key_files(rosrm, robot):
    result = rosrm("key", "check", "--host", "robot-1")
    shown = facts(result)
    assert result.code == 0
    assert shown["commands"] == ["user:ada, role viewer, key 2"]
    assert shown["slave"] == ["host:robot-1, role host, key 2"]
    assert shown["files"] == ["2 key files, 2 of them readable by this user alone"]
    assert facts(rosrm("key", "check"))["slave"] == ["no key"]  # its name is not `desk`


def test_the_variable_chooses_a_key(rosrm, robot, monkeypatch):
    monkeypatch.setenv("ROSRM_KEY", str(robot / "ada.key"))
    shown = facts(rosrm("key", "check", "--host", "robot-1"))
    assert shown["commands"] == ["user:ada, role viewer, key 2"]
    assert shown["slave"] == ["no key: ROSRM_KEY names that of user:ada"]
    monkeypatch.setenv("ROSRM_KEY", str(robot / "none.key"))
    result = rosrm("key", "check")
    assert result.code == 1
    assert facts(result)["problem"] == [f"the key file {robot}/none.key does not exist"]


def test_security_that_is_switched_off_is_shown(rosrm, secret, monkeypatch):
    monkeypatch.setenv("ROSRM_SECURITY", "none")
    shown = facts(rosrm("key", "check"))
    assert shown["security"] == ["none (ROSRM_SECURITY): keys are not used"]


def test_a_directory_that_others_can_write_is_a_problem(rosrm, home, secret):
    home.chmod(0o777)
    result = rosrm("key", "check")
    assert result.code == 1
    assert facts(result)["problem"] == [
        f"other users can replace files in {home}; run `chmod 700 {home}`"
    ]


def test_one_file_is_described_and_compared_with_the_grants(rosrm, home, secret, tmp_path):
    path = tmp_path / "robot-1.key"
    rosrm("key", "add", "host:robot-1", "--out", path)
    number = key_files.read_key(path).grant.generation
    described = (
        f"robot-1.key    host:robot-1, role host, key {number}; only this user can read the file\n"
    )
    result = rosrm("key", "check", path)
    assert (result.code, result.out) == (
        0, f"{described}valid          yes, in this user's cluster\n"
    )  # fmt: skip
    rosrm("key", "revoke", "host:robot-1")
    result = rosrm("key", "check", path)
    assert result.code == 1
    assert result.out == (
        f"{described}valid          no\n"
        "problem        the key of host:robot-1 is not valid in the cluster of this "
        "machine: it was revoked or replaced, or is of another cluster\n"
    )


def test_one_file_is_described_on_a_machine_without_the_grants(rosrm, robot):
    result = rosrm("key", "check", robot / "robot-1.key")
    assert result.code == 0
    assert result.out == (
        "robot-1.key    host:robot-1, role host, key 2; only this user can read the file\n"
        "valid          unknown: only the machine of the master can check this\n"
    )
