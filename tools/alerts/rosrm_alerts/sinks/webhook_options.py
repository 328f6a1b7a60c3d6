"""Options of the webhook, apart from the HTTP client, which would cost each slave 3 MB."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

from rosrm import PositiveSeconds


@dataclass(frozen=True)
class WebhookOptions:
    """Options of the sink.

    Attributes:
        url: http or https address.
        headers: path of a file with further headers, a line `Name: value` each, for example with a
            token; "": none.
        timeout: seconds for one request.
    """

    url: str = ""
    headers: str = ""
    timeout: PositiveSeconds = 10.0

    def __post_init__(self) -> None:
        """Refuse other schemes; raises `ValueError`."""
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"url: {self.url!r} is no address, such as https://example.com/hook")
