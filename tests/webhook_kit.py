"""A real HTTP server for tests of the webhook."""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from typing_extensions import Self

from tests.waiting import wait_until


class Receiver:
    """Takes notices on a free port of the loopback address; a context manager.

    Attributes:
        bodies: the JSON bodies of all requests with the answer 200, in order.
        headers: headers of the last request.
        answer: status of the next answers.
    """

    def __init__(self) -> None:
        self.bodies: list[Any] = []
        self.headers: dict[str, str] = {}
        self.answer = 200
        self.requests = 0
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.requests += 1
                receiver.headers = dict(self.headers)
                if receiver.answer == 200:
                    receiver.bodies.append(json.loads(body))
                self.send_response(receiver.answer)
                if receiver.answer in (301, 302):
                    self.send_header("Location", "/elsewhere")
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Print nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}/hook"

    @property
    def notices(self) -> list[dict[str, Any]]:
        return [notice for body in self.bodies for notice in body["notices"]]

    def wait_for(self, **wanted: str) -> dict[str, Any]:
        """Return the first notice with some values, once it is here."""

        def found() -> list[dict[str, Any]]:
            return [one for one in self.notices if wanted.items() <= one.items()]

        return wait_until(found, f"a notice {wanted}", seen=lambda: self.notices)[0]

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
