"""The table of the files of state names each module that writes one, with what it survives."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "reference" / "state-files.md"
ROWS = [
    [cell.strip() for cell in line.strip("| \n").split(" | ")]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if re.match(r"\| .*\.py`", line)
]
WRITERS = {path: row for row in ROWS for path in re.findall(r"`([a-z_/]+\.py)`", row[1])}
#: Modules that write what nobody reads again after a loss of power, and why.
NO_STATE = {
    "plugins/container/rosrm_container/start.py": "a key inside a container, which ends",
    "plugins/criu/rosrm_criu/control/messages.py": "messages between running processes",
    "plugins/criu/rosrm_criu/engine/copied_pages.py": "pages of a move under way",
    "plugins/criu/rosrm_criu/engine/memory_copy.py": "pages of a move under way",
    "plugins/criu/rosrm_criu/engine/open_files.py": "files of a process, part of its image",
    "plugins/criu/rosrm_criu/engine/put_back.py": "files of a process that is restored",
    "plugins/criu/rosrm_criu/engine/restore_result.py": "answer of a restore to its caller",
    "plugins/criu/rosrm_criu/engine/shim.py": "files of the kernel",
    "plugins/criu/rosrm_criu/engine/udp_ports.py": "ports of a restore under way",
    "plugins/criu/rosrm_criu/executors/artifacts.py": "a note beside an image that is sent",
    "plugins/criu/rosrm_criu/transfer/archive.py": "an image that is received; checked by digest",
    "plugins/criu/rosrm_criu/transfer/certificate.py": "a file in memory",
    "rosrm/cli/commands/service.py": "a unit of systemd, for the user",
    "rosrm/cli/new_plugin.py": "a new project, for the user",
    "rosrm/cli/up/cluster.py": "a lock",
    "rosrm/component/link.py": "the title of a process",
    "rosrm/runtime/durable.py": "for the modules of the table",
    "rosrm/runtime/private_files.py": "for the modules of the table",
    "rosrm/runtime/process_title.py": "a file of the kernel",
    "rosrm/runtime/state_lock.py": "a lock, which the kernel holds",
    "rosrm/runtime/timer_slack.py": "a file of the kernel",
    "rosrm/slave/state_disk.py": "a file without a name, to try the disk",
    "rosrm/slave/textfile.py": "metrics, written again every few seconds",
    "rosrm/supervisor/endpoint.py": "a lock, and its own log",
    "rosrm/testing/local_cluster.py": "output of parts",
    "tools/alerts/rosrm_alerts/sinks/mcap_file.py": "a file for the user",
    "tools/lab/rosrm_lab/disks.py": "a disk of the lab",
    "tools/lab/rosrm_lab/groups.py": "files of the kernel",
    "tools/lab/rosrm_lab/inside/init.py": "a file in memory of a host of the lab",
    "tools/report/rosrm_report/sources.py": "a copy to read from",
    "tools/report/rosrm_report/writing.py": "a report for the user",
    "tools/web/rosrm_web/metrics/command.py": "metrics, written again every few seconds",
}
_WRITES = {"write_bytes", "write_text", "touch", "symlink_to", "hardlink_to"}
_DURABLE = re.compile(r"(replace|rename|append)_(durably|atomically)")
_OPENS = {"open", "open_private", "fdopen"}
_MOVES = {"rename", "replace", "link", "copyfile", "copytree", "copy2", "move"}
_MODES = re.compile(r"'[wax]b?\+?'|'rb?\+b?'|O_CREAT|O_TRUNC|O_APPEND")


def _writes(call: ast.Call) -> bool:
    """Return True if a call creates or changes a file."""
    function = call.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    owner = ast.unparse(function.value) if isinstance(function, ast.Attribute) else ""
    text = ast.unparse(call)
    if name in _OPENS:
        written = bool(_MODES.search(text)) or (owner == "os" and len(call.args) > 2)
        return written and "devnull" not in text and "dup(" not in text
    if name == "connect":
        return owner == "sqlite3"
    if name == "touch":
        return "mode" in text or owner.startswith("(")
    if owner == "durable" or _DURABLE.fullmatch(name):
        return name not in {"lease_kept_here", "check_thread"}
    return name in _WRITES or (name in _MOVES and owner in {"os", "shutil"})


def _modules() -> list[str]:
    found = []
    for folder in ("rosrm", "plugins", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            if any(isinstance(one, ast.Call) and _writes(one) for one in ast.walk(tree)):
                found.append(path.relative_to(ROOT).as_posix())
    return found


def test_each_module_that_writes_files_is_in_the_table_or_writes_no_state() -> None:
    modules = set(_modules())
    assert modules - WRITERS.keys() - NO_STATE.keys() == set()
    assert NO_STATE.keys() - modules == set()
    assert {path for path in WRITERS if not (ROOT / path).is_file()} == set()


@pytest.mark.parametrize(
    "path", [path for path, row in WRITERS.items() if row[2].startswith("a loss of power")]
)
def test_what_survives_a_loss_of_power_is_forced_to_the_disk(path) -> None:
    """By one of the durable functions, by SQLite's default, or by the module that calls it."""
    text = (ROOT / path).read_text(encoding="utf-8")
    called = path == "rosrm/artifacts/unpack.py"  # `cache.py` forces what it has unpacked
    assert called or re.search(r"durabl[ey]|fsync|sqlite3", text)


def test_each_row_has_an_answer_for_each_condition() -> None:
    assert len(ROWS) > 15
    assert {row[0] for row in ROWS if len(row) != 8 or not all(row)} == set()
