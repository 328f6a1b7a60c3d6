"""Tokens of the gateway: the file, and who may do what."""

from __future__ import annotations

import pytest

from rosrm.errors import ConfigError
from rosrm_web.access import Access
from rosrm_web.guard import Guard, Rejected
from rosrm_web.settings import Settings, checked
from rosrm_web.tokens import read_tokens, user_of

VIEWER, OPERATOR = "v" * 24, "o" * 32
FILE = f"# role name token\n\nviewer grafana {VIEWER}\n  operator ada@desk {OPERATOR}\n"


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file of tokens with a mode."""

    def write(text=FILE, mode=0o600):
        file = tmp_path / "tokens"
        file.write_text(text)
        file.chmod(mode)
        return file

    return write


def test_the_users_of_a_file(write):
    """Comments and empty lines are skipped, and no user shows its token."""
    users = read_tokens(write())

    assert [(one.name, one.role) for one in users] == [
        ("grafana", "viewer"),
        ("ada@desk", "operator"),
    ]
    assert VIEWER not in repr(users)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620])
def test_a_file_that_others_can_read_or_change_is_refused(write, mode):
    """The error has the remedy."""
    with pytest.raises(ConfigError, match=r"other users can read or change it; `chmod 600 "):
        read_tokens(write(mode=mode))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "it has no token"),
        ("# none\n", "it has no token"),
        (f"viewer {VIEWER}\n", "tokens:1: `ROLE NAME TOKEN` is required"),
        (f"\nroot ada {VIEWER}\n", "tokens:2: the first word is a role: viewer or operator"),
        (f"viewer a/b {VIEWER}\n", "tokens:1: a name has"),
        (f"viewer ada {'x' * 23}\n", "tokens:1: the token of ada is too short"),
        (f"viewer ada {'ü' * 24}\n", "tokens:1: the token of ada"),
        (
            f"viewer ada {VIEWER}\nviewer ada {OPERATOR}\n",
            "tokens:2: the name 'ada' is there twice",
        ),
    ],
)
def test_an_invalid_file_is_refused(write, text, says):
    """With file and line, and without the token."""
    with pytest.raises(ConfigError) as refused:
        read_tokens(write(text))
    assert says in str(refused.value)
    assert "x" * 23 not in str(refused.value)


def test_a_missing_file_and_a_file_that_is_no_text_are_refused(tmp_path, write):
    """Before the gateway listens."""
    with pytest.raises(ConfigError, match=r"--tokens .*: cannot be read: No such file"):
        read_tokens(tmp_path / "none")
    binary = write()
    binary.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"--tokens .*: cannot be read: "):
        read_tokens(binary)


@pytest.mark.parametrize(
    ("header", "name"),
    [
        (f"Bearer {OPERATOR}", "ada@desk"),
        (f"bearer  {VIEWER} ", "grafana"),
        ("", None),
        ("Bearer", None),
        ("Bearer " + OPERATOR[:-1], None),
        (f"Basic {OPERATOR}", None),
        (f"Bearer {OPERATOR} {VIEWER}", None),
        ("Bearer \xff\x00", None),
    ],
)
def test_the_user_of_a_header(write, header, name):
    """Only a whole token counts."""
    user = user_of(header, read_tokens(write()))

    assert (user.name if user else None) == name


def ask(write, method, token, *, acting=True):
    """Return the user of a request, as far as tokens and rights are concerned."""
    guard = Guard(None, Settings(is_acting=acting), Access(read_tokens(write())))
    headers = {"authorization": f"Bearer {token}"} if token else {}
    return guard.user_of_request({"type": "http", "method": method, "path": "/v1/hosts"}, headers)


@pytest.mark.parametrize(
    ("method", "token", "acting"),
    [("GET", VIEWER, True), ("GET", OPERATOR, False), ("POST", OPERATOR, True)],
)
def test_viewers_read_and_operators_act(write, method, token, acting):
    """A token is needed for both."""
    assert ask(write, method, token, acting=acting).name


@pytest.mark.parametrize(
    ("method", "token", "acting", "status"),
    [
        ("GET", "", True, 401),
        ("GET", "wrong" * 6, True, 401),
        ("POST", "", True, 401),
        ("POST", VIEWER, True, 403),
        ("POST", OPERATOR, False, 403),  # without --allow-actions
        ("DELETE", VIEWER, True, 403),
    ],
)
def test_a_request_without_the_right_is_refused(write, method, token, acting, status):
    """No message contains a token."""
    with pytest.raises(Rejected) as refused:
        ask(write, method, token, acting=acting)
    assert refused.value.status == status
    assert "wrong" * 6 not in str(refused.value)


def test_without_tokens_everyone_reads_and_nobody_acts():
    """The default on this machine."""
    guard = Guard(None, Settings(), Access())

    assert (
        guard.user_of_request({"type": "http", "method": "GET", "path": "/v1/hosts"}, {}).role
        == "viewer"
    )
    with pytest.raises(Rejected, match="only reads"):
        guard.user_of_request({"type": "http", "method": "POST", "path": "/v1/drain"}, {})


def test_other_machines_need_tokens(write):
    """An address that others reach is refused without a file of tokens."""
    with pytest.raises(ConfigError, match="--tokens FILE"):
        checked("0.0.0.0", plain_http=True)
    assert checked("0.0.0.0", plain_http=True, tokens=write()).users


def test_actions_need_an_operator(write):
    """--allow-actions without a token of an operator could never be used."""
    with pytest.raises(ConfigError, match="operator NAME TOKEN"):
        checked("127.0.0.1", allow_actions=True)
    with pytest.raises(ConfigError, match="operator NAME TOKEN"):
        checked("127.0.0.1", allow_actions=True, tokens=write(f"viewer ada {VIEWER}"))
    assert checked("127.0.0.1", allow_actions=True, tokens=write()).is_acting
