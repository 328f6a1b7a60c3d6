"""Check of a settings file while a runtime runs, in a process of its own.

The check imports pydantic and loads plugins, for which the runtimes have neither memory nor time.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any, Final, Generic, TypeVar

from rosrm import clocks
from rosrm.model.orders import CHECK_TIMEOUT
from rosrm.runtime.memory_file import memory_file
from rosrm.wording import ending_of

Config = TypeVar("Config")

_MODULE: Final = "rosrm.config.rereading"

#: Called with the settings, None if the file cannot be used; then with the reason, else "".
Checked = Callable[[Config | None, str], None]


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


class SettingsCheck(Generic[Config]):
    """Reads a settings file again; the runtime calls `poll` until the check has ended.

    Args:
        source: origin of the settings.
        from_json: returns the settings from the JSON that the check prints.
        after_signal: gets the outcome of a check that a signal has requested.
    """

    def __init__(
        self, source: SettingsSource, from_json: Callable[[str], Config],
        after_signal: Checked[Config],
    ) -> None:  # fmt: skip
        self._source, self._from_json, self._after_signal = source, from_json, after_signal
        self._hung_up = False
        self._process: subprocess.Popen[bytes] | None = None
        self._waiting: list[Checked[Config]] = []
        self._deadline = 0.0

    def start(self, done: Checked[Config]) -> None:
        """Begin a check, unless one is under way; call `done` with its outcome."""
        if not self._source.path:
            role = self._source.role
            done(None, f"the {role} was started without a file: start it with `--config FILE`")
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
        self._output = os.fdopen(memory_file("rosrm-check"), "w+b")
        self._errors = os.fdopen(memory_file("rosrm-check"), "w+b")
        words = [source.role, source.path, "" if source.domain is None else str(source.domain)]
        path_option = ["-P"] if getattr(sys.flags, "safe_path", False) else []
        self._process = subprocess.Popen(
            [sys.executable, *path_option, "-m", _MODULE, *words],
            stdin=subprocess.DEVNULL, stdout=self._output, stderr=self._errors,
            env={**os.environ, "PYTHONWARNINGS": "ignore"},
        )  # fmt: skip
        self._deadline = clocks.boot_time() + CHECK_TIMEOUT - 1.0

    def poll(self) -> None:
        """Report the outcome of a check that has ended, or took too long."""
        if self._hung_up:
            self._hung_up = False
            self.start(self._after_signal)
        process = self._process
        if process is None:
            return
        code = process.poll()
        if code is None and clocks.boot_time() < self._deadline:
            return
        if code is None:
            process.kill()  # its end is not awaited: the file may be on a disk without an answer
        settings, errors = _read(self._output), _read(self._errors)
        self._process = None
        if code is None:
            errors = f"the check of {self._source.path} took more than {CHECK_TIMEOUT - 1.0:g} s"
        fault = "" if code == 0 else errors or f"the check: {ending_of(code or 0)}"
        self._tell("" if fault else settings, fault)

    def _tell(self, text: str, fault: str) -> None:
        config = None
        if not fault:
            config, fault = self._settings_of(text)
        waiting, self._waiting = self._waiting, []
        for done in waiting:
            done(config, fault)

    def _settings_of(self, text: str) -> tuple[Config | None, str]:
        """Return the printed settings, or None and why this process cannot read them."""
        try:
            return self._from_json(text), ""
        except Exception as error:  # noqa: BLE001 - another version may print anything
            return None, (
                f"the settings in {self._source.path} are valid, but this {self._source.role} "
                f"cannot read them: {error}. If rosrm was upgraded since its start, restart it"
            )

    def close(self) -> None:
        """End a check that runs."""
        if self._process is not None:
            self._process.kill()


def _read(file: IO[bytes]) -> str:
    with file:
        file.seek(0)
        return file.read().decode(errors="replace").strip()
