"""Event sink that posts notices to a web address."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from rosrm import ConfigError, Notice, NoticesRefused, RosrmError
from rosrm_alerts.sinks.webhook_options import WebhookOptions

#: Answers after which a repetition of the request may succeed, besides all of 500 and above.
_TRANSIENT: Final = (408, 425, 429)


class Webhook:
    """Posts `{"text": "one line per notice", "notices": [...]}`.

    Chat services that take `text` (Mattermost, Slack) need no program between.
    """

    def __init__(self, options: WebhookOptions) -> None:
        self._options = options
        self._headers = {"Content-Type": "application/json", "User-Agent": "rosrm"}
        if options.headers:
            self._headers |= read_headers(Path(options.headers).expanduser())
        # Without a redirect handler, an answer of 300 and above is an error.
        self._opener = urllib.request.build_opener(_NoRedirects())

    def send(self, notices: Sequence[Notice]) -> None:
        """Post notices in one request."""
        text = "\n".join(f"{one.level}: {one.message}" for one in notices)
        body = json.dumps({"text": text, "notices": [one.form() for one in notices]})
        request = urllib.request.Request(  # noqa: S310 - the options allow http and https only
            self._options.url, body.encode(), self._headers, method="POST"
        )
        host = urlsplit(self._options.url).hostname
        try:
            with self._opener.open(request, timeout=self._options.timeout) as answer:
                answer.read(1)
        except urllib.error.HTTPError as error:
            said = f"{host} answers {error.code} {error.reason}"
            error.close()
            if 400 <= error.code < 500 and error.code not in _TRANSIENT:
                raise NoticesRefused(said) from None
            raise RosrmError(said) from None
        except (OSError, HTTPException) as error:
            raise RosrmError(f"{host}: {getattr(error, 'reason', error)}") from None

    def close(self) -> None:
        """Do nothing; no connection is kept."""


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Refuses redirects, because they would turn a POST into a GET."""

    def redirect_request(self, *_: object) -> None:
        """Return None: no redirect."""


def read_headers(path: Path) -> dict[str, str]:
    """Return the headers of a file; raise `ConfigError` if it cannot be read or parsed."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as fault:
        raise ConfigError(f"headers: {path}: {fault}") from None
    headers = {}
    for number, line in enumerate(lines, 1):
        name, colon, value = line.partition(":")
        if not line.strip():
            continue
        if not colon or not name.strip() or " " in name.strip():
            raise ConfigError(f"headers: {path}, line {number}: `Name: value` is required")
        headers[name.strip()] = value.strip()
    return headers
