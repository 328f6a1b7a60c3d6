"""Sessions of browsers: ids that only this gateway knows, and that end with their token."""

from __future__ import annotations

import asyncio
import errno
import logging
import resource
from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm_web import serving
from rosrm_web.access import MOST_OPEN, Access
from rosrm_web.guard import LARGEST_LOGIN, Guard
from rosrm_web.master_link import Busy
from rosrm_web.page.login import Login
from rosrm_web.sessions import LIFETIME, MOST_OF_USER, Sessions, cookie_name, cookie_of
from rosrm_web.settings import Settings
from rosrm_web.tokens import ANYONE, User

TOKEN = "o" * 24
ADA = User("ada", "operator", sha256(TOKEN.encode()).digest())
BOB = User("bob", "viewer", sha256(b"v" * 24).digest())


def test_a_session_ends_with_the_token_of_its_user():
    """The session has the newest role of its token, and ends with the token."""
    access = Access((ADA, BOB))
    sessions = Sessions(access)
    ada, bob = sessions.begin(ADA), sessions.begin(BOB)
    assert (sessions.user_of(ada), sessions.user_of(bob)) == (ADA, BOB)
    viewer = User("ada", "viewer", ADA.digest)
    access.users = (viewer,)
    assert (sessions.user_of(ada), sessions.user_of(bob)) == (viewer, None)


def test_another_gateway_knows_no_session_of_this_one():
    """Neither another gateway nor the next run accepts the id; a token is no id either."""
    access = Access((ADA,))
    number = Sessions(access).begin(ADA)
    assert Sessions(access).user_of(number) is None
    assert Sessions(access).user_of(TOKEN) is None


def test_sessions_end_and_are_bounded():
    """A user's newest sessions stay, and a forgotten browser has to log in again."""
    now = [0.0]
    sessions = Sessions(Access((ADA, BOB)), clock=lambda: now[0])
    bob = sessions.begin(BOB)
    numbers = [sessions.begin(ADA) for _ in range(3 * MOST_OF_USER)]
    assert [sessions.user_of(one) for one in numbers].count(ADA) == MOST_OF_USER
    assert sessions.user_of(numbers[-1]) == ADA
    assert sessions.user_of(bob) == BOB
    now[0] = LIFETIME + 1.0
    assert sessions.user_of(bob) is None
    sessions.begin(ADA)
    assert len(sessions._known) == 1


@given(st.text())
def test_any_cookie_header_is_read(header):
    """Programs and other sites on the host send what they like."""
    assert isinstance(cookie_of(header, "rosrm-session-8290"), str)


@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("a@b=c; s=1", "1"), ("s=1; a@b=c", "1"), ("s", ""), ("", ""), ("xs=1", ""),
        ('s="1"', "1"), ("s=1; s=2", "1"), (";;=;s=1", "1"),
    ],
)  # fmt: skip
def test_the_value_of_a_cookie_is_found_among_others(header, value):
    """Cookies with names that are no names do not hide it."""
    assert cookie_of(header, "s") == value


def login(settings, body, port=8290, access=None):
    """Send the form through the guard; return the status and the headers of the answer."""
    access = access or Access(settings.users)
    sessions = Sessions(access)
    form = Login(settings, access, sessions)
    sent, parts = [], [body[start : start + 2**16] for start in range(0, len(body), 2**16)] or [b""]

    async def app(scope, receive, send):
        from fastapi import Request

        answer = await form.enter(Request(scope, receive))
        await answer(scope, receive, send)

    async def receive():
        return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

    async def send(message):
        sent.append(message)

    scope = {
        "type": "http", "method": "POST", "path": "/login", "query_string": b"",
        "server": ("127.0.0.1", port), "headers": [(b"host", b"localhost")],
    }  # fmt: skip
    asyncio.run(Guard(app, settings, access, sessions)(scope, receive, send))
    headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], headers, sessions


def test_the_form_sets_a_cookie_without_the_token():
    """Without HTTPS its name has the port, because browsers send it to all ports of the host."""
    status, headers, sessions = login(Settings(users=(ADA,)), f"token={TOKEN}".encode())
    cookie = headers["set-cookie"]
    assert status == 303
    assert TOKEN not in cookie
    assert cookie.startswith("rosrm-session-8290=")
    assert "HttpOnly" in cookie
    number = cookie_of(cookie, cookie_name(is_secure=False, port=8290))
    assert sessions.user_of(number) == ADA


def test_with_https_the_cookie_is_bound_to_the_host(tmp_path):
    """Browsers take a cookie with this prefix only with these attributes."""
    settings = Settings(users=(ADA,), certificate=tmp_path)
    _, headers, _ = login(settings, f"token={TOKEN}".encode())
    cookie = headers["set-cookie"]
    assert cookie.startswith("__Host-")
    assert "Secure" in cookie
    assert "Path=/" in cookie
    assert "domain" not in cookie.lower()


@pytest.mark.parametrize("body", [b"a=1&" * 2**20, b"x" * (LARGEST_LOGIN + 1)])
def test_a_large_login_is_refused_before_it_is_read(body):
    """A client without a token may send only a few kB."""
    status, _, _ = login(Settings(users=(ADA,)), body)
    assert status == 413


def test_a_login_with_many_fields_is_a_wrong_token():
    """A form with more fields than the bound counts as a wrong token."""
    status, _, _ = login(Settings(users=(ADA,)), b"a=1&" * 1000)
    assert status == 401


def test_one_user_leaves_room_for_the_requests_and_pages_of_others():
    """The bound is for each user where tokens are required."""
    access = Access((ADA, BOB))
    closing = [access.open(ADA, lambda: None) for _ in range(MOST_OPEN)]
    with pytest.raises(Busy, match="ada has"):
        access.check_room(ADA)
    access.check_room(BOB)
    closing[0]()
    access.check_room(ADA)
    for _ in range(2 * MOST_OPEN):
        access.open(ANYONE, lambda: None)
    access.check_room(ANYONE)


def test_a_flood_of_connections_fills_no_log(caplog):
    """One line says that connections cannot be accepted, later ones say how many more."""
    now = [0.0]
    handle = serving.AcceptErrors(clock=lambda: now[0])
    context = {"message": "accept", "exception": OSError(errno.EMFILE, "Too many open files")}
    loop = asyncio.new_event_loop()
    with caplog.at_level(logging.INFO):
        for _ in range(1000):
            handle(loop, context)
        now[0] = 60.0
        handle(loop, context)
    loop.close()
    assert len(caplog.messages) == 2
    assert "999 more" in caplog.messages[1]
    assert sum(map(len, caplog.messages)) < 1000


def test_other_errors_are_logged_as_ever(caplog):
    """Only repeated errors of accepting connections are shortened."""
    loop = asyncio.new_event_loop()
    serving.AcceptErrors()(loop, {"message": "m", "exception": ValueError("x")})
    loop.close()
    assert "ValueError" in caplog.text


def test_connections_leave_files_for_the_master():
    """The limit of open files exceeds what connections take, where the system allows it."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
        serving.allow_descriptors()
        hard = before[1] if before[1] != resource.RLIM_INFINITY else 2**30
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= min(8192, hard)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
