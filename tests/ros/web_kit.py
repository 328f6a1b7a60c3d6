"""A real `rosrm web` beside a cluster of a test, and an HTTP client for it."""

from __future__ import annotations

import http.client
import json
import os
import signal
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from rosrm.model.ros_settings import RosSettings
from tests.waiting import PATIENCE, wait_until

#: Seconds for the start of a gateway, which takes 3 s of CPU time, on a busy machine.
START_PATIENCE = 3 * PATIENCE


@dataclass(frozen=True)
class Answer:
    """An HTTP answer."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Change(NamedTuple):
    """A server-sent event with the sequence in its id; 0: it has none."""

    kind: str
    number: int
    data: Any


class Gateway:
    """A running `rosrm web`.

    Attributes:
        url: address that the command printed.
    """

    def __init__(self, ros: RosSettings, *words: str, tls: ssl.SSLContext | None = None) -> None:
        self._tls = tls
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rosrm.cli", "web", "--listen", "127.0.0.1:0", *words],
            env={**os.environ, **ros.environment(), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.said: list[str] = []
        threads = [
            threading.Thread(target=self.said.extend, args=(stream,), daemon=True)
            for stream in (self.process.stdout, self.process.stderr)
        ]
        for thread in threads:
            thread.start()
        self.url = ""

    def wait_for_address(self) -> None:
        self.url = wait_until(
            self._url, "rosrm web prints its address", START_PATIENCE, seen=lambda: self.said
        )

    def _url(self) -> str:
        lines = [line for line in self.said if line.startswith("rosrm web: ")]
        assert self.process.poll() is None, self.said
        return lines[0].split()[2].rstrip(";") if lines else ""

    @property
    def address(self) -> tuple[str, int]:
        parts = urlsplit(self.url)
        return str(parts.hostname), int(parts.port or 0)

    def _connection(self) -> http.client.HTTPConnection:
        if self._tls is None:
            return http.client.HTTPConnection(*self.address, timeout=PATIENCE)
        return http.client.HTTPSConnection(*self.address, timeout=PATIENCE, context=self._tls)

    def ask(self, path: str, body: object = None, **headers: str) -> Answer:
        """Send a request: GET, or POST with a body."""
        connection = self._connection()
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        content = body if isinstance(body, (str, bytes)) else body and json.dumps(body)
        if body is not None:
            given.setdefault("Content-Type", "application/json")
        try:
            connection.request("GET" if body is None else "POST", path, content, given)
            answer = connection.getresponse()
            return Answer(answer.status, dict(answer.headers), answer.read())
        finally:
            connection.close()

    def get(self, path: str) -> Any:
        """Return the value at a path, which has to be there."""
        answer = self.ask(path)
        assert answer.status == 200, answer
        return answer.json

    @contextmanager
    def follow(self, path: str = "/v1/changes", **headers: str) -> Iterator[Iterator[Change]]:
        """Yield an iterator over server-sent events."""
        connection = self._connection()
        try:
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            assert answer.status == 200, answer.read()
            assert answer.headers["content-type"].startswith("text/event-stream")
            yield _changes(answer)
        finally:
            connection.close()

    def wait_for_master(self, state: str) -> None:
        wait_until(
            lambda: self.get("/v1/status")["gateway"]["state"] == state,
            f"the gateway says that the master is {state}",
            seen=lambda: self.get("/v1/status")["gateway"],
        )  # fmt: skip

    def end(self, number: int = signal.SIGINT) -> int:
        """End the gateway with a signal; return its exit code."""
        self.process.send_signal(number)
        try:
            return self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise


def _changes(lines: Iterable[bytes]) -> Iterator[Change]:
    fields: dict[str, str] = {}
    for line in lines:
        name, mark, value = line.decode().rstrip("\n").partition(": ")
        if mark:
            fields[name] = value
        elif fields:
            yield Change(
                fields["event"],
                int(fields.get("id", "0").partition("-")[0]),
                json.loads(fields["data"]),
            )
            fields = {}


@contextmanager
def gateway(ros: RosSettings, *words: str, tls: ssl.SSLContext | None = None) -> Iterator[Gateway]:
    """Yield a gateway that ends afterwards, with success and without a traceback."""
    one = Gateway(ros, *words, tls=tls)
    try:
        one.wait_for_address()
        yield one
    except Exception:  # of any test: it is raised again, after what explains it
        print(f"the gateway printed: {one.said}")
        raise
    finally:
        code = one.end() if one.process.poll() is None else 0
    assert code == 0, one.said
    assert not any("Traceback" in line for line in one.said), "".join(one.said)
