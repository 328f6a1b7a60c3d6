"""The page of `rosrm web` beside a demo."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Final

from rosrm import RosSettings

_ADDRESS: Final = "127.0.0.1"
_USUAL_PORT: Final = 8290
#: Beginning of the line in which the gateway prints its address.
_READY: Final = "rosrm web: "
#: Seconds on a busy machine; a gateway that is killed leaves its shared memory.
_END_S: Final = 30.0


class DemoPage:
    """A gateway that only reads. It starts beside the demo, which continues without it."""

    def __init__(self, ros: RosSettings, log: Path) -> None:
        """Start the gateway.

        Args:
            ros: settings of the cluster.
            log: file for its errors.
        """
        self._log = log
        self._announced = False
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rosrm.cli", "web", "--listen", f"{_ADDRESS}:{_port()}"],
                env={**os.environ, **ros.environment(), "PYTHONUNBUFFERED": "1"},
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=sink, text=True,
                start_new_session=True,  # Ctrl-C must reach only the demo, which ends the gateway
            )  # fmt: skip
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)

    def news(self) -> str:
        """Return a sentence with the address or the failure of the page, once; otherwise ""."""
        if self._announced:
            return ""
        assert self._process.stdout is not None
        ended = self._process.poll() is not None
        line = self._process.stdout.readline()
        if line.startswith(_READY):
            self._announced = True
            return f"the page of this cluster, until the demo ends: {_url(line)}"
        if ended:
            self._announced = True
            return f"without a page: `rosrm web` ended; see {self._log}"
        return ""

    def close(self) -> None:
        """End the gateway."""
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()


def _url(line: str) -> str:
    return line.removeprefix(_READY).partition(";")[0]


def _port() -> int:
    """Return the usual port, or 0 for any free one if it is in use."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_ADDRESS, _USUAL_PORT))
        except OSError:
            return 0
    return _USUAL_PORT
