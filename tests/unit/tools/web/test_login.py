"""Form for the token of a user."""

from __future__ import annotations

import asyncio
import logging
from hashlib import sha256

import pytest
from fastapi import Request

from rosrm_web.access import Access
from rosrm_web.page.login import Login
from rosrm_web.sessions import Sessions
from rosrm_web.settings import Settings
from rosrm_web.tokens import User

TOKEN = "o" * 24
USERS = (User("ada", "operator", sha256(TOKEN.encode()).digest()),)


@pytest.mark.parametrize(
    ("token", "status", "line"),
    [(TOKEN, 303, "ada: logged in"), ("x" * 24, 401, "a wrong token was given in the form")],
)
def test_the_log_says_who_logs_in(caplog, token, status, line):
    """A refused login is logged too, without its token."""

    async def receive():
        return {"type": "http.request", "body": f"token={token}".encode()}

    access = Access(USERS)
    form = Request({"type": "http", "method": "POST", "path": "/login", "headers": []}, receive)
    with caplog.at_level(logging.INFO, "rosrm.web"):
        answer = asyncio.run(Login(Settings(users=USERS), access, Sessions(access)).enter(form))

    assert (answer.status_code, caplog.messages) == (status, [line])
