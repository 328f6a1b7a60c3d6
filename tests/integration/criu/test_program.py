"""Choice of the CRIU program, and its error messages, with scripts in place of CRIU."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine.binary import CriuBinary, default_prefix, find, opened
from tests.waiting import wait_until

ANSWERS = 'if [ "$1" = --version ]; then echo "Version: {}"; exit; fi\n'


def script(path: Path, body: str = "", version: str = "4.2.1") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n" + ANSWERS.format(version) + body)
    path.chmod(0o755)
    return path


@pytest.fixture(autouse=True)
def nothing_else(tmp_path, monkeypatch):
    """Hide every other CRIU of this machine, and put a test folder into PATH."""
    monkeypatch.delenv("ROSRM_CRIU", raising=False)
    monkeypatch.setattr("rosrm_criu.engine.binary._PLACES", str(tmp_path / "sbin"))
    monkeypatch.setenv("PATH", str(tmp_path / "path"))


def test_the_variable_goes_before_the_prefix_and_that_before_path(tmp_path, monkeypatch):
    script(tmp_path / "path/criu", version="1.1")
    assert find(tmp_path / "prefix") == CriuBinary((str(tmp_path / "path/criu"),), "1.1")
    private = script(tmp_path / "prefix/bin/criu", version="2.2.2")
    assert find(tmp_path / "prefix") == CriuBinary((str(private),), "2.2.2")
    named = script(tmp_path / "named", version="3.3")
    monkeypatch.setenv("ROSRM_CRIU", str(named))
    assert find(tmp_path / "prefix") == CriuBinary((str(named),), "3.3")


def test_criu_is_found_where_debian_installs_it(tmp_path):
    debian = script(tmp_path / "sbin/criu")
    assert find(tmp_path / "prefix").command == (str(debian),)


def test_a_criu_that_does_not_start_is_skipped(tmp_path):
    script(tmp_path / "prefix/bin/criu", "exit 127\n", version="").write_text("#!/bin/no-shell\n")
    script(tmp_path / "path/criu")
    assert find(tmp_path / "prefix").command == (str(tmp_path / "path/criu"),)


def test_where_no_criu_starts_the_error_has_each_reason(tmp_path):
    script(tmp_path / "prefix/bin/criu").write_text("#!/bin/no-shell\n")
    script(tmp_path / "path/criu").write_text("#!/bin/sh\necho libz is missing >&2; exit 127\n")
    with pytest.raises(CriuError) as raised:
        find(tmp_path / "prefix")
    said = str(raised.value)
    assert "prefix/bin/criu cannot be started: the C library that it names is missing" in said
    assert "`--version` printed 'libz is missing' (exit code 127)" in said
    assert said.endswith("`scripts/install_criu.sh` of rosrm's repository installs one in a folder")


@pytest.mark.parametrize("kind", ["missing", "folder", "other"])
def test_the_variable_must_name_a_working_criu(kind, tmp_path, monkeypatch):
    """An invalid ROSRM_CRIU fails, although another CRIU works, which the user did not name."""
    script(tmp_path / "path/criu")
    named = tmp_path / "named"
    if kind == "folder":
        named.mkdir()
    elif kind == "other":
        named.write_text("#!/bin/sh\necho hello\n")
        named.chmod(0o755)
    monkeypatch.setenv("ROSRM_CRIU", str(named))
    with pytest.raises(CriuError, match=r"^ROSRM_CRIU names a CRIU that cannot be used: /"):
        find(tmp_path / "prefix")


def test_the_prefix_is_below_the_users_data_or_where_a_variable_says(monkeypatch):
    monkeypatch.delenv("ROSRM_CRIU_PREFIX")
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/ada")
    assert default_prefix() == Path("/home/ada/.local/share/rosrm/criu")
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert default_prefix() == Path("/data/rosrm/criu")
    monkeypatch.setenv("ROSRM_CRIU_PREFIX", "/opt/criu")
    assert default_prefix() == Path("/opt/criu")


# --- execution ---------------------------------------------------------------------------------

#: Part of a script: finds the path after --log-file and writes to that file.
FAILS = """
while [ "$1" != --log-file ]; do shift; done
echo '(00.1) Error (criu/sk-unix.c:874): unix: External socket is used.' >"$2"
echo '(00.1) Error (criu/cr-dump.c:1975): Dumping FAILED.' >>"$2"
exit 1
"""


def test_a_failure_reports_the_cause_of_the_log(tmp_path):
    criu = opened(script(tmp_path / "criu", FAILS))
    log = tmp_path / "dump.log"
    with pytest.raises(CriuError) as raised:
        criu.run(["dump", "--tree", "1"], timeout=30, log=log)
    told = "CRIU 4.2.1 could not dump: unix: External socket is used."
    assert str(raised.value) == f"{told} (its log: {log})"


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("echo 'Error: no such option' >&2; exit 2", "no such option"),
        ("echo 'criu: what is --tree?'; echo 'Try --help'; exit 2", "criu: what is --tree?"),
        ("exit 3", "exit code 3, without a reason"),
        ("kill -9 $$", "killed by SIGKILL, without a reason"),
    ],
)
def test_a_failure_without_a_log_reports_the_output(tmp_path, body, expected):
    log = tmp_path / "log"
    log.write_text("(00.1) Error (a.c:1): an older failure\n")
    with pytest.raises(CriuError, match=r"could not dump: ") as raised:
        opened(script(tmp_path / "criu", body)).run(["dump"], timeout=30, log=log)
    assert str(raised.value) == f"CRIU 4.2.1 could not dump: {expected} (its log: {log})"


def test_a_hanging_criu_is_ended_with_its_children(tmp_path):
    body = f"echo $$ >{tmp_path}/pid; /bin/sleep 1000 & /bin/sleep 1000"
    criu = opened(script(tmp_path / "criu", body))
    began = time.monotonic()
    with pytest.raises(CriuError, match=r"could not dump: it was not done after 1 s and was ended"):
        criu.run(["dump"], timeout=1.0, log=tmp_path / "log")
    assert time.monotonic() - began < 60
    group = int((tmp_path / "pid").read_text())
    wait_until(lambda: not members(group), "the end of its children")


def members(group: int) -> list[int]:
    """Return the processes of a group, without zombies."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(of) == group and state != "Z":
            found.append(int(stat.parent.name))
    return found


def test_criu_inherits_only_the_given_files_and_no_input(tmp_path):
    read, write = os.pipe()
    try:
        criu = opened(
            script(tmp_path / "criu", f'read -r line && exit 1; echo "$1" >/proc/self/fd/{write}')
        )
        criu.run(["dump"], timeout=30, log=tmp_path / "log", pass_fds=[write])
        assert os.read(read, 100) == b"dump\n"
    finally:
        os.close(read)
        os.close(write)


def test_criu_runs_unprivileged_where_rights_are_missing(tmp_path):
    """`--unprivileged` depends on the capability, because root in a container may lack it."""
    told = tmp_path / "told"
    program = script(tmp_path / "criu", f'echo "$@" >{told}')
    code = (
        "import sys; from pathlib import Path; from rosrm_criu.engine.binary import CriuBinary\n"
        "CriuBinary((sys.argv[1],), '4.2').run(['dump'], timeout=30, log=Path(sys.argv[2]))"
    )
    words = [sys.executable, "-c", code, program, tmp_path / "log"]
    subprocess.run(words, check=True)
    expected = "dump" if os.geteuid() == 0 else "dump --unprivileged"
    assert told.read_text() == f"{expected} --log-file {tmp_path}/log\n"
    if os.geteuid() == 0:
        without = ["/usr/bin/setpriv", "--bounding-set=-sys_admin", "--inh-caps=-sys_admin"]
        if subprocess.run([*without, "/bin/true"], check=False).returncode != 0:
            pytest.skip("not all rights to give away")
        subprocess.run([*without, *words], check=True)
        assert told.read_text() == f"dump --unprivileged --log-file {tmp_path}/log\n"
