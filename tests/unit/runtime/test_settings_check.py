"""Check of a settings file in a process of its own."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.core.master.events import SettingsRead
from rosrm.extensions.registry import Registry
from rosrm.master.chain_creation import ChainCreation
from rosrm.master.settings_reload import SettingsReload
from rosrm.runtime.settings_check import SettingsCheck, SettingsSource
from tests.waiting import wait_until


def outcome(source: SettingsSource) -> tuple[Any, str]:
    """Return the settings and the fault of one check."""
    found: list[tuple[Any, str]] = []
    kind = ClusterConfig if source.role == "master" else HostConfig
    check = SettingsCheck(source, kind.from_json, lambda *_: None)
    check.start(lambda config, fault: found.append((config, fault)))

    def is_done() -> bool:
        check.poll()
        return bool(found)

    wait_until(is_done, "the check has ended")
    return found[0]


def test_a_valid_file_yields_its_settings_with_the_domain_of_the_command_line(
    tmp_path: Path,
) -> None:
    """So a reload does not count the domain as a difference."""
    path = tmp_path / "cluster.yaml"
    path.write_text("queue: {backfill: true}\nros: {domain: 3}\n")
    config, fault = outcome(SettingsSource("master", str(path), 7))
    assert fault == ""
    assert (config.queue.backfill, config.ros.domain) == (True, 7)


def test_an_invalid_file_yields_place_and_allowed_values(tmp_path: Path) -> None:
    """As a start with this file does."""
    path = tmp_path / "host.yaml"
    path.write_text("host: h\nlimts: {memory: 0.5}\n")
    config, fault = outcome(SettingsSource("slave", str(path)))
    assert config is None
    assert f"{path}:2:1" in fault
    assert "did you mean 'limits'?" in fault
    path.write_text("host: h\nlimits: {memory: 0.5}\n")
    assert outcome(SettingsSource("slave", str(path)))[0].limits["memory"]


def test_what_a_plugin_prints_is_no_part_of_the_settings(tmp_path: Path, imported) -> None:
    """A plugin may print when it is imported, also from C."""
    imported("import os\nprint('hello')\nos.write(1, b'hello again')\n")
    path = tmp_path / "host.yaml"
    path.write_text("host: h\n")
    config, fault = outcome(SettingsSource("slave", str(path)))
    assert (config.host, fault) == ("h", "")


def test_a_thread_that_a_plugin_leaves_does_not_lengthen_the_check(
    tmp_path: Path, imported
) -> None:
    """The check ends, and the reload is not refused."""
    imported("import threading, time\nthreading.Thread(target=time.sleep, args=(1000,)).start()\n")
    path = tmp_path / "host.yaml"
    path.write_text("host: h\n")
    config, fault = outcome(SettingsSource("slave", str(path)))
    assert (config and config.host, fault) == ("h", "")


#: Lets a check print what a later version of rosrm might.
_LATER = """
from rosrm.config.settings import ClusterConfig, HostConfig
ClusterConfig.to_json = HostConfig.to_json = lambda self: '{"colour": "red"}'
"""


def test_settings_of_another_version_are_a_fault_of_the_reload(tmp_path: Path, imported) -> None:
    """Such as after an upgrade of rosrm; they ended a slave, and the master."""
    imported(_LATER)
    path = tmp_path / "settings.yaml"
    path.write_text("host: h\n")
    config, fault = outcome(SettingsSource("slave", str(path)))
    assert config is None
    assert fault.startswith(f"the settings in {path} are valid, but this slave cannot read them: ")
    assert "colour" in fault
    assert fault.endswith("If rosrm was upgraded since its start, restart it")

    path.write_text("name: n\n")
    chains = ChainCreation(Registry.of(), 1.0)
    reload = SettingsReload(ClusterConfig(), SettingsSource("master", str(path)), chains)
    reload.start(7)
    read: list[SettingsRead] = []
    wait_until(lambda: read.extend(reload.poll()) or read, "the file was read")
    (event,) = read
    assert (event.request, event.settings) == (7, None)
    assert "this master cannot read them" in event.fault


def test_a_check_that_cannot_be_started_is_a_fault(tmp_path: Path, monkeypatch) -> None:
    """The runtime keeps its settings, and can check the file later."""
    path = tmp_path / "host.yaml"
    path.write_text("host: h\n")
    source, found = SettingsSource("slave", str(path)), list[tuple[Any, str]]()
    check = SettingsCheck(source, HostConfig.from_json, lambda *_: None)

    def refused(_name: str) -> int:
        raise OSError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as limited:
        limited.setattr(os, "memfd_create", refused)
        limited.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
        check.start(lambda *answer: found.append(answer))
    ((config, fault),) = found
    assert config is None
    assert fault.startswith(f"the check of {path} cannot be started: ")
    check.start(lambda *answer: found.append(answer))
    wait_until(lambda: check.poll() or found[1:], "the check has ended")
    assert found[1][1] == ""


def test_a_runtime_without_a_file_has_nothing_to_read() -> None:
    """The answer says how to start it with one."""
    assert outcome(SettingsSource("slave")) == (
        None, "the slave was started without a file: start it with `--config FILE`",
    )  # fmt: skip


_SIGNALLED = """
import os, signal, sys
from rosrm.runtime.bootstrap import handle_signals
heard = []
handle_signals(lambda *_: heard.append("stop"), lambda *_: heard.append("reload"))
os.kill(os.getpid(), signal.SIGHUP)
print(*heard)
"""


def said_after_sighup(**how: object) -> str:
    run = subprocess.run(
        [sys.executable, "-c", _SIGNALLED], check=True, capture_output=True, text=True, **how
    )
    return run.stdout.strip()


def test_a_sighup_without_a_terminal_reloads() -> None:
    """As of a service manager: `kill -HUP`."""
    assert said_after_sighup(start_new_session=True) == "reload"


def test_a_sighup_with_a_terminal_stops() -> None:
    """Its terminal was closed."""
    pty = pytest.importorskip("pty")
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", _SIGNALLED])
    with os.fdopen(terminal, "rb", buffering=0) as output:
        assert output.read(100).split() == [b"stop"]
    os.waitpid(pid, 0)


def test_an_ignored_sighup_stays_ignored() -> None:
    """As by `nohup`."""
    ignore = lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)  # noqa: E731
    assert said_after_sighup(start_new_session=True, preexec_fn=ignore) == ""
