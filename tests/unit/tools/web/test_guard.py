"""Checks of requests before any route: host names, origins, bodies, headers."""

from __future__ import annotations

import asyncio
from hashlib import sha256

import pytest

from rosrm_web import guard
from rosrm_web.access import Access
from rosrm_web.sessions import Sessions
from rosrm_web.settings import Settings
from rosrm_web.tokens import User

TOKEN = "o" * 24
#: A gateway with one operator, who sends all requests that act.
ACTING = Settings(users=(User("ada", "operator", sha256(TOKEN.encode()).digest()),), is_acting=True)
NAMES = frozenset({"localhost", "robot-1"})


def scope(method="GET", kind="http", **headers):
    headers = {"authorization": f"Bearer {TOKEN}", **headers}
    listed = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    return {"type": kind, "method": method, "path": "/", "headers": listed}


class Seen:
    """An application that notes the bodies it gets, and answers with 204."""

    def __init__(self):
        self.bodies = []

    async def __call__(self, scope, receive, send):
        self.bodies.append((await receive())["body"])
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})


def request(wanted, *parts, app=None, sessions=None):
    """Pass a request with the parts of its body; return the status, or the code of a WebSocket."""
    messages = [
        {"type": "http.request", "body": part, "more_body": True} for part in parts
    ] + [{"type": "http.request", "body": b"", "more_body": False}]  # fmt: skip
    sent = []

    async def receive():
        return messages.pop(0)

    async def send(message):
        sent.append(message)

    checked = guard.Guard(app or Seen(), ACTING, Access(ACTING.users), sessions)
    asyncio.run(checked(wanted, receive, send))
    return sent[0]


@pytest.mark.parametrize(
    "host",
    ["localhost", "LOCALHOST:8290", "127.0.0.1:8290", "[::1]:8290", "192.0.2.7", "robot-1:1"],
)
def test_addresses_and_names_of_this_machine_are_allowed(host):
    """A page of the internet can take none of these for its own origin."""
    guard.check_host({"host": host}, NAMES)


@pytest.mark.parametrize(
    "host",
    ["", "evil.example", "evil.example:8290", "localhost.evil.example", "127.0.0.1.nip.io"],
)
def test_another_host_name_is_refused(host):
    """DNS rebinding: the name is the attacker's, the address is ours."""
    with pytest.raises(guard.Rejected) as refused:
        guard.check_host({"host": host}, NAMES)
    assert refused.value.status == 421


@pytest.mark.parametrize(
    ("kind", "method", "headers"),
    [
        ("http", "POST", {"origin": "https://evil.example"}),
        ("http", "POST", {"origin": "null"}),
        ("http", "POST", {"origin": "https://localhost:8290"}),  # another scheme
        ("http", "POST", {"sec_fetch_site": "cross-site"}),
        ("http", "DELETE", {"sec_fetch_site": "same-site"}),
        ("websocket", "GET", {"origin": "https://evil.example"}),
    ],
)
def test_a_request_that_acts_must_be_of_our_own_page(kind, method, headers):
    """A foreign page that the user has open cannot act with the user's rights (CSRF)."""
    answer = request(scope(method, kind, host="localhost:8290", **headers))

    assert answer.get("status", answer.get("code")) in (403, 1008)


@pytest.mark.parametrize("headers", [{}, {"origin": "http://localhost:8290"}])
def test_our_own_page_and_programs_may_act(headers):
    """A program sends no origin."""
    assert request(scope("POST", host="localhost:8290", **headers))["status"] == 204


def test_a_foreign_page_may_load_what_its_browser_hides_from_it():
    """A link from another page is followed: only requests that act are refused."""
    assert request(scope(host="localhost", sec_fetch_site="cross-site"))["status"] == 204


def test_a_body_arrives_whole():
    """The application gets the parts as one."""
    app = Seen()

    assert request(scope("POST", host="localhost"), b"ab", b"c", app=app)["status"] == 204
    assert app.bodies == [b"abc"]


@pytest.mark.parametrize(
    ("headers", "parts"),
    [
        ({"content_length": str(guard.LARGEST_BODY + 1)}, []),
        ({}, [b"x" * guard.LARGEST_BODY, b"x"]),  # chunked: no length is announced
    ],
)
def test_a_giant_body_is_refused(headers, parts):
    """The application never sees the request."""
    app = Seen()

    answer = request(scope("POST", host="localhost", **headers), *parts, app=app)

    assert (answer["status"], app.bodies) == (413, [])


def test_a_body_that_never_ends_is_refused(monkeypatch):
    """A client that stops in the middle of its body does not keep the connection."""
    monkeypatch.setattr(guard, "BODY_TIMEOUT", 0.01)

    async def never():
        await asyncio.Event().wait()

    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(
        guard.Guard(Seen(), ACTING, Access(ACTING.users))(
            scope("POST", host="localhost"), never, send
        )
    )
    assert sent[0]["status"] == 408


@pytest.mark.parametrize("name", ["host", "origin", "authorization"])
def test_a_header_that_decides_is_there_once(name):
    """Two values would be read in two ways."""
    twice = scope("GET", host="localhost")
    twice["headers"] += [(name.encode(), b"a"), (name.encode(), b"b")]

    assert request(twice)["status"] == 400


def test_every_answer_has_the_headers_of_a_strict_page():
    """Accepted and refused requests have them; an application may choose its own value."""

    async def page(scope, receive, send):
        own = [(b"Content-Security-Policy", b"default-src 'self'")]
        await send({"type": "http.response.start", "status": 200, "headers": own})

    refused = dict(request(scope(host="evil.example"))["headers"])
    own = request(scope(host="localhost"), app=page)["headers"]

    assert refused[b"x-frame-options"] == b"DENY"
    assert [value for name, value in own if name.lower() == b"content-security-policy"] == [
        b"default-src 'self'"
    ]
    assert dict(own)[b"x-content-type-options"] == b"nosniff"


@pytest.mark.parametrize("other", ["other=1", "a@b=c", "=", "a@b=c; other"])
def test_the_cookie_of_the_form_is_a_session(other):
    """Browsers send no Authorization header for a page; other cookies may have any content."""
    sessions = Sessions(Access(ACTING.users))
    number = sessions.begin(ACTING.users[0])

    def status(value):
        cookie = f"{other}; rosrm-session-0={value}"
        sent = scope(host="localhost", cookie=cookie)
        sent["headers"] = [one for one in sent["headers"] if one[0] != b"authorization"]
        return request(sent, sessions=sessions)["status"]

    assert [status(value) for value in (number, "no", TOKEN)] == [204, 303, 303]


def test_a_browser_without_a_token_is_led_to_the_form():
    """Programs get 401 for all other paths."""
    answer = request(scope(host="localhost", authorization=""))

    assert (answer["status"], dict(answer["headers"])[b"location"]) == (303, b"/login")
    assert (
        request({**scope(host="localhost", authorization=""), "path": "/v1/hosts"})["status"] == 401
    )
    assert request({**scope(host="localhost", authorization=""), "path": "/login"})["status"] == 204
