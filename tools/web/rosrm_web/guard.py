"""Checks of each request before any other code sees it, and the headers of each answer."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from types import MappingProxyType
from typing import Any, Final

from rosrm_web import problems
from rosrm_web.access import Access
from rosrm_web.master_link import Busy
from rosrm_web.sessions import Sessions, cookie_name, cookie_of
from rosrm_web.settings import Settings
from rosrm_web.tokens import ANYONE, LOGIN, User, user_of

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

#: Most bytes of the body of a request, such as a work file.
LARGEST_BODY: Final = 4 * 2**20
#: Maximum bytes of the body of a request without a valid token: the form for the token.
LARGEST_LOGIN: Final = 4 * 2**10
#: Seconds for the body of a request.
BODY_TIMEOUT: Final = 10.0
#: Methods that change nothing.
_SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
#: Values of Sec-Fetch-Site, which browsers send, for a request of our own page or of the user.
_OWN_SITES: Final = frozenset({"", "none", "same-origin"})

#: Headers of every answer. No other page may read, frame or guess it, and no cache keeps it.
_HEADERS: Final = {
    b"cache-control": b"no-store",
    b"content-security-policy": b"default-src 'none'; frame-ancestors 'none'",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"permissions-policy": b"camera=(), geolocation=(), microphone=()",
    b"referrer-policy": b"same-origin",
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
}
#: Policy for the page and its files: nothing from outside. NiceGUI compiles templates there.
_PAGE_POLICY: Final = (
    b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    b"style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src 'self' data:; "
    b"connect-src 'self'; frame-ancestors 'none'; form-action 'self'; base-uri 'self'"
)
#: Paths that are no page.
_FOR_PROGRAMS: Final = ("/v1/", "/metrics")
_WITH_TLS: Final = {b"strict-transport-security": b"max-age=31536000"}


_log = logging.getLogger("rosrm.web")


class Rejected(Exception):
    """A request that is answered without a look at its path.

    Args:
        status: HTTP status code.
        detail: sentence for the user.
        headers: of the answer.
    """

    def __init__(
        self, status: int, detail: str, headers: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.headers = headers


class Guard:
    """ASGI application that checks requests, and passes valid ones to another application."""

    def __init__(
        self, app: App, settings: Settings, access: Access, sessions: Sessions | None = None
    ) -> None:
        self._app = app
        self._settings, self._access = settings, access
        self._sessions = sessions or Sessions(access)
        self._headers = {**_HEADERS, **(_WITH_TLS if settings.certificate else {})}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        is_page = not scope["path"].startswith(_FOR_PROGRAMS)
        try:
            headers = single_headers(scope["headers"])
            check_host(headers, self._settings.host_names)
            check_origin(scope, headers, self._settings.scheme)
            user = self.user_of_request(scope, headers)
            if scope["type"] == "http":
                most = LARGEST_LOGIN if scope["path"] == LOGIN else LARGEST_BODY
                receive = await _with_body(scope, headers, receive, most)
            self._access.check_room(user)
        except Busy as error:
            refusal = Rejected(429, str(error), {"retry-after": "5"})
            await _reject(refusal, scope, receive, self._hardened(send))
            return
        except Rejected as error:
            await _reject(error, scope, receive, self._hardened(send))
            return
        scope["user"] = user
        scope["may_act"] = self._settings.is_acting and user.role == "operator"
        acts = scope.get("method", "GET") not in _SAFE and scope["path"] != LOGIN
        note = f"{user.name}: {scope['method']} {scope['path']!r:.100}" if acts else ""
        with self._access.open_request(user):
            await self._app(scope, receive, self._hardened(send, note, is_page=is_page))

    def user_of_request(self, scope: Scope, headers: Mapping[str, str]) -> User:
        """Return the user of a request; refuse it if the user may not send it."""
        if scope["path"] == LOGIN:
            return ANYONE
        users = self._access.users
        user = self._known_user(scope, headers) if users else ANYONE
        if user is None and scope["path"] == "/":
            raise Rejected(303, "a token is required", {"location": LOGIN})
        if user is None:
            raise Rejected(
                401, "the token is missing or wrong: `Authorization: Bearer TOKEN` is required",
                {"www-authenticate": "Bearer"},
            )  # fmt: skip
        if scope.get("method", "GET") in _SAFE:
            return user
        if not self._settings.is_acting:
            raise Rejected(
                403, "this gateway only reads; `rosrm web --allow-actions --tokens FILE` acts, too"
            )
        if user.role != "operator":
            raise Rejected(403, f"{user.name} is a {user.role}: only operators may act")
        return user

    def _known_user(self, scope: Scope, headers: Mapping[str, str]) -> User | None:
        """Return the user of the token of a request, or else of its cookie."""
        if "authorization" in headers:
            return user_of(headers["authorization"], self._access.users)
        name = cookie_name(is_secure=self._settings.certificate is not None, port=port_of(scope))
        return self._sessions.user_of(cookie_of(headers.get("cookie", ""), name))

    def _hardened(self, send: Send, note: str = "", *, is_page: bool = False) -> Send:
        """Return `send` with the headers of every answer; an application may set its own.

        With a note, the status of the answer is logged after it.
        """
        headers = self._headers
        if is_page:
            headers = {**headers, b"content-security-policy": _PAGE_POLICY}

        async def send_hardened(message: Message) -> None:
            if message["type"] == "http.response.start":
                if note:
                    _log.info("%s: %d", note, message["status"])
                given = list(message.get("headers", ()))
                names = {name.lower() for name, _ in given}
                ours = [one for one in headers.items() if one[0] not in names]
                message = {**message, "headers": [*given, *ours]}
            await send(message)

        return send_hardened


def port_of(scope: Scope) -> int:
    """Return the port of the gateway to which a request was sent; 0: unknown."""
    return int((scope.get("server") or ("", 0))[1] or 0)


def single_headers(headers: list[tuple[bytes, bytes]]) -> Mapping[str, str]:
    """Return the headers of a request; refuse a second value of one that the guard reads."""
    found: dict[str, str] = {}
    for name, value in headers:
        key = name.decode("latin-1").lower()
        if key in found and key in ("host", "origin", "authorization", "content-length"):
            raise Rejected(400, f"the header {key} is there twice")
        found[key] = value.decode("latin-1")
    return found


def check_host(headers: Mapping[str, str], names: frozenset[str]) -> None:
    """Refuse a request for another host name.

    A page of the internet can let its own name point to this machine (DNS rebinding), but then its
    requests carry that name.
    """
    host = headers.get("host", "")
    bare = _without_port(host).lower()
    if bare in names or _is_address(bare):
        return
    raise Rejected(
        421, f"the request is for the host {host!r:.100}. Allowed: the IP address of this machine, "
        f"{', '.join(sorted(names))}, and names given by `rosrm web --name NAME`",
    )  # fmt: skip


def _without_port(host: str) -> str:
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def check_origin(scope: Scope, headers: Mapping[str, str], scheme: str) -> None:
    """Refuse a request that acts, or a WebSocket, if a page of another origin sends it."""
    if scope["type"] == "http" and scope["method"] in _SAFE:
        return
    origin = headers.get("origin", "")
    is_own = origin in ("", f"{scheme}://{headers.get('host', '')}")
    if not is_own or headers.get("sec-fetch-site", "") not in _OWN_SITES:
        raise Rejected(403, f"a page of another origin sent the request: {origin!r:.100}")


async def _with_body(
    scope: Scope, headers: Mapping[str, str], receive: Receive, most: int
) -> Receive:
    """Read the whole body of at most so many bytes, and return a `receive` that repeats it."""
    announced = headers.get("content-length", "0")
    if announced.isdecimal() and (len(announced) > 15 or int(announced) > most):
        raise _too_large(most)
    try:
        body = await asyncio.wait_for(_body(receive, most), BODY_TIMEOUT)
    except asyncio.TimeoutError:
        raise Rejected(408, f"the body did not arrive within {BODY_TIMEOUT:g} s") from None
    if body and scope["method"] in _SAFE:
        raise Rejected(400, f"a {scope['method']} request has no body")
    first: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def repeat() -> Message:
        return first.pop() if first else await receive()

    return repeat


async def _body(receive: Receive, most: int) -> bytes:
    parts: list[bytes] = []
    size = 0
    while True:
        message = await receive()
        if message["type"] != "http.request":
            raise Rejected(400, "the client left before its request was complete")
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if size > most:
            raise _too_large(most)
        if not message.get("more_body", False):
            return b"".join(parts)


def _too_large(most: int) -> Rejected:
    return Rejected(413, f"the body of this request is at most {most} bytes")


async def _reject(error: Rejected, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": str(error)[:100]})
        return
    # The rest of the request is not read: the connection must not be used again.
    headers = {**error.headers, "connection": "close"}
    await problems.answer(error.status, str(error), headers=headers)(scope, receive, send)
