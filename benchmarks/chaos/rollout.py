"""Versions of an application, applied one after the other during the faults."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.chaos import work
from benchmarks.chaos.client_load import ClientLoad, ClientRequest
from benchmarks.chaos.oracle import Versions


class Rollout:
    """The application of the benchmark, and the requests for its versions, one after the other.

    Args:
        folder: for the work files.
        lines: folder for the lines of the workload.
        versions: kept for the oracle.
        tell: is called with a line for each request and its outcome.

    Attributes:
        state: of the application by the newest answer, as text.
        is_settled: the application has reached the version, or has returned to the former one.
    """

    def __init__(
        self, client_load: ClientLoad, folder: Path, lines: Path, versions: Versions,
        tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._client_load = client_load
        self._folder = folder
        self._lines = lines
        self._versions = versions
        self._tell = tell
        self._number = self._open = 0
        self.state = ""
        self.is_settled = True

    def apply(self, *, faulty: bool) -> None:
        """Request the next version; in a faulty one, one process ends, each time another."""
        self._number += 1
        number, self._versions.newest = self._number, self._number
        names = [one.name for one in work.rolled()]
        broken = names[number % len(names)] if faulty else ""
        path = self._folder / f"version{number}.yaml"
        path.write_text(json.dumps(work.version(number, self._lines, broken)))  # JSON is YAML too
        self._tell(f"version {number} is applied{', with a faulty ' + broken if faulty else ''}")
        self.is_settled = False
        self._send({"do": "apply", "work": str(path)}, self._accept, persistent=True)

    def look(self) -> None:
        """Ask for the state of the application unless it is settled or a request is open."""
        if not self.is_settled and not self._open:
            request = {"do": "application", "name": work.APPLICATION}
            self._send(request, self._take, persistent=False)

    def close(self) -> None:
        """Expect only the version that runs, until another is applied."""
        versions = self._versions
        versions.former = versions.newest = versions.expected
        versions.returned, versions.repeated = "", False

    def _send(
        self, request: dict[str, Any], done: Callable[[ClientRequest], None], *, persistent: bool
    ) -> None:
        self._open += 1
        self._client_load.send(ClientRequest(request, persistent=persistent, done=done))

    def _accept(self, client_request: ClientRequest) -> None:
        self._open -= 1
        self._versions.repeated |= client_request.unsure
        self._versions.processes = tuple(one.name for one in work.rolled())

    def _take(self, client_request: ClientRequest) -> None:
        self._open -= 1
        self.state = str(client_request.answer)
        if client_request.answer.get("state") == "running":
            self.is_settled = True
            self._versions.returned = client_request.answer["returned"]
            self._tell(f"version {self._versions.newest}: {self.state}")
