"""Check of a settings file while a runtime runs, in a process of its own.

The check imports pydantic and loads plugins, for which the runtimes have neither memory nor time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any, Final

from rosrm.model.orders import CHECK_TIMEOUT

_MODULE: Final = "rosrm.config.rereading"

#: Called with the settings as JSON, and with the reason why the file cannot be used; one is "".
Checked = Callable[[str, str], None]


@dataclass(frozen=True, slots=True)
class SettingsSource:
    """Origin of the settings of a runtime.

    Attributes:
        role: "master" or "slave".
        path: absolute path of the file; "": the runtime was started without a file.
        domain: ROS domain of the command line; None: none was given.
    """

    role: str
    path: str = ""
    domain: int | None = None


class SettingsCheck:
    """Reads a settings file again; the runtime calls `poll` until the check has ended.

    Args:
        source: origin of the settings.
        after_signal: gets the outcome of a check that a signal has requested.
    """

    def __init__(self, source: SettingsSource, after_signal: Checked) -> None:
        self._source, self._after_signal = source, after_signal
        self._hung_up = False
        self._process: subprocess.Popen[bytes] | None = None
        self._waiting: list[Checked] = []
        self._deadline = 0.0

    def start(self, done: Checked) -> None:
        """Begin a check, unless one is under way; call `done` with its outcome."""
        if not self._source.path:
            role = self._source.role
            done("", f"the {role} was started without a file: start it with `--config FILE`")
            return
        self._waiting.append(done)
        if self._process is None:
            try:
                self._begin()
            except OSError as error:
                self._tell("", f"the check of {self._source.path} cannot be started: {error}")

    def hang_up(self, _number: int, _frame: Any) -> None:
        """Handle a SIGHUP: let the next `poll` begin a check."""
        self._hung_up = True

    def _begin(self) -> None:
        source = self._source
        # Files, because the check would wait for a reader of a full pipe.
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - `poll` closes it
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - as above
        words = [source.role, source.path, "" if source.domain is None else str(source.domain)]
        path_option = ["-P"] if getattr(sys.flags, "safe_path", False) else []
        self._process = subprocess.Popen(
            [sys.executable, *path_option, "-m", _MODULE, *words],
            stdin=subprocess.DEVNULL, stdout=self._output, stderr=self._errors,
            env={**os.environ, "PYTHONWARNINGS": "ignore"},
        )  # fmt: skip
        self._deadline = time.monotonic() + CHECK_TIMEOUT - 1.0

    def poll(self) -> None:
        """Report the outcome of a check that has ended, or took too long."""
        if self._hung_up:
            self._hung_up = False
            self.start(self._after_signal)
        process = self._process
        if process is None:
            return
        code = process.poll()
        if code is None and time.monotonic() < self._deadline:
            return
        if code is None:
            process.kill()
            process.wait()
        settings, errors = _read(self._output), _read(self._errors)
        self._process = None
        if code is None:
            errors = f"the check of {self._source.path} took more than {CHECK_TIMEOUT - 1.0:g} s"
        fault = "" if code == 0 else errors or f"the check ended with exit code {code}"
        self._tell("" if fault else settings, fault)

    def _tell(self, settings: str, fault: str) -> None:
        waiting, self._waiting = self._waiting, []
        for done in waiting:
            done(settings, fault)

    def close(self) -> None:
        """End a check that runs."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def _read(file: IO[bytes]) -> str:
    with file:
        file.seek(0)
        return file.read().decode(errors="replace").strip()
