"""Form for the token of a user; a cookie has the id of a session from then on."""

from __future__ import annotations

import logging
from html import escape
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qs

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from rosrm_web.guard import port_of
from rosrm_web.sessions import LIFETIME, cookie_name
from rosrm_web.tokens import user_of

if TYPE_CHECKING:
    from rosrm_web.access import Access
    from rosrm_web.sessions import Sessions
    from rosrm_web.settings import Settings

_log = logging.getLogger("rosrm.web")

_FORM: Final = """<!doctype html>
<html lang="en"><head><title>rosrm: token</title><link rel="icon" href="data:,">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"></head>
<body><main><h1>rosrm</h1><p>{message}</p>
<form method="post"><label>Token <input type="password" name="token" autofocus required
autocomplete="current-password"></label> <button>Log in</button></form></main></body></html>
"""


class Login:
    """Endpoints of the form."""

    def __init__(self, settings: Settings, access: Access, sessions: Sessions) -> None:
        self._settings, self._access, self._sessions = settings, access, sessions

    async def show(self) -> Response:
        """Show the form."""
        return _page("This gateway needs the token of a user.")

    async def enter(self, request: Request) -> Response:
        """Check the token of the form, and set the cookie."""
        body = (await request.body()).decode("latin-1")
        try:
            token = parse_qs(body, max_num_fields=4).get("token", [""])[0].strip()
        except ValueError:
            token = ""
        user = user_of(f"Bearer {token}", self._access.users)
        if user is None:
            _log.warning("a wrong token was given in the form")
            return _page("The token is wrong.", 401)
        _log.info("%s: logged in", user.name)
        answer = RedirectResponse("/", 303)
        is_secure = self._settings.certificate is not None
        answer.set_cookie(
            cookie_name(is_secure=is_secure, port=port_of(request.scope)),
            self._sessions.begin(user), max_age=int(LIFETIME), httponly=True, samesite="strict",
            secure=is_secure, path="/",
        )  # fmt: skip
        return answer


def _page(message: str, status: int = 200) -> Response:
    return HTMLResponse(_FORM.format(message=escape(message)), status)
