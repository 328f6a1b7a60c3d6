"""`rosrm service`: units of systemd, as systemd reads them."""

from __future__ import annotations

import os
import pwd
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.cli.commands import service
from rosrm.cli.systemd_unit import needed_variables, unit_text
from rosrm.errors import ConfigError
from tests.programs import needs

ME = pwd.getpwuid(os.geteuid()).pw_name
with_systemd = needs("systemd-analyze")


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Use directories of the test for the units of the machine and of the user."""
    monkeypatch.setattr(service, "SYSTEM_UNITS", tmp_path / "system")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("SUDO_USER", raising=False)
    return {False: tmp_path / "system", True: tmp_path / "config/systemd/user"}


@pytest.fixture
def host_file(tmp_path):
    (tmp_path / "host.yaml").write_text("host: robot\non_stop: keep\n", encoding="utf-8")
    return tmp_path / "host.yaml"


def complaints(text, directory, of_user):
    """Return the lines in which systemd complains about a unit."""
    path = directory / "rosrm-part.service"
    path.write_text(text, encoding="utf-8")
    where = ["--user"] if of_user else []
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *where, str(path)],
        env={**os.environ, "XDG_RUNTIME_DIR": str(directory)},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    if "initialize manager" in done.stderr:
        pytest.skip(f"systemd-analyze verify does not work here: {done.stderr.strip()}")
    # Systemd before version 254 ignores this key, and says so.
    lines = [line for line in done.stderr.splitlines() if path.name in line]
    return [line for line in lines if "'DelegateSubgroup'" not in line]


@with_systemd
@pytest.mark.parametrize("of_user", [False, True], ids=["machine", "user"])
@pytest.mark.parametrize("part", ["master", "slave"])
def test_systemd_accepts_each_unit(part, of_user, tmp_path):
    """Each key is known, and the program is found below a path with special characters."""
    program = tmp_path / "a b%c$d" / "rosrm"
    program.parent.mkdir()
    program.symlink_to("/bin/true")
    variables = {"PATH": "/bin:/a b%", "ROS_X": '"\\$'}
    text = unit_text(part, [str(program), part], variables, None if of_user else "root")
    assert complaints(text, tmp_path, of_user) == []


@with_systemd
def test_a_wrong_unit_would_be_noticed(tmp_path):
    """The check above fails for an unknown key, and for a program that does not exist."""
    text = unit_text("slave", ["/none/rosrm"], {}, "root")
    assert len(complaints(text.replace("RestartSec", "Bogus"), tmp_path, of_user=False)) >= 2


@pytest.mark.parametrize("of_user", [False, True], ids=["machine", "user"])
def test_a_unit_is_written_once_checked_and_removed_once_disabled(
    of_user, places, host_file, rosrm, monkeypatch
):
    """The unit runs the slave with its file; a second install replaces it."""
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    options = ["--user"] if of_user else []
    path = places[of_user] / "rosrm-slave.service"
    command = ["service", "install", "slave", "--config", host_file, "--domain", 3, *options]
    printed = rosrm(*command, "--dry-run").out
    assert not path.exists()
    for _ in range(2):
        done = rosrm(*command)
        assert done.code == 0, done.err
    assert path.read_text(encoding="utf-8") == printed
    assert f'"slave" "--config" "{host_file}" "--domain" "3"\n' in printed
    assert 'Environment="ROS_DOMAIN_ID=7"\n' in printed
    assert (f"User={ME}\n" in printed) is not of_user
    assert "systemctl" in done.out
    assert "on_stop" not in done.out
    target = "default.target.wants" if of_user else "multi-user.target.wants"
    (path.parent / target).mkdir()
    link = path.parent / target / path.name
    link.symlink_to(path)
    refused = rosrm("service", "remove", "slave", *options)
    assert (refused.code, path.exists()) == (2, True)
    assert "disable --now rosrm-slave.service" in refused.err
    link.unlink()
    assert rosrm("service", "remove", "slave", *options, "--dry-run").code == 0
    assert path.exists()
    assert rosrm("service", "remove", "slave", *options).code == 0
    assert not path.exists()
    assert rosrm("service", "remove", "slave", *options).code == 2


def test_a_unit_of_another_author_is_kept(places, rosrm):
    """Neither command touches a file that rosrm has not written."""
    path = places[True] / "rosrm-master.service"
    path.parent.mkdir(parents=True)
    path.write_text("[Unit]\n", encoding="utf-8")
    for command in ("install", "remove"):
        done = rosrm("service", command, "master", "--user")
        assert (done.code, path.read_text(encoding="utf-8")) == (2, "[Unit]\n")
        assert "was not written by" in done.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--config", "none.yaml"], "none.yaml"),
        (["--run-as", "no-such-user"], "no-such-user"),
        (["--user", "--run-as", ME], "leave out --user"),
    ],
)
def test_what_cannot_run_is_refused_before_a_unit_is_written(words, said, places, rosrm):
    """A wrong file, an unknown user and contradicting options write nothing."""
    done = rosrm("service", "install", "slave", *words)
    assert done.code == 2
    assert said in done.err
    assert not any(one.exists() for one in places.values())


def test_a_directory_without_the_right_to_write_names_the_way_out(tmp_path, monkeypatch, rosrm):
    """Without root, the message has the command line with sudo."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(service, "SYSTEM_UNITS", tmp_path / "file" / "system")
    done = rosrm("service", "install", "master")
    assert done.code == 1
    assert "--dry-run | sudo tee" in done.err


def test_the_slave_says_that_its_processes_end_with_it(places, rosrm):
    """Without `on_stop: keep` a restart of the service ends the processes."""
    assert "on_stop: keep" in rosrm("service", "install", "slave", "--user").out


def test_only_variables_of_ros_and_rosrm_are_needed():
    """Secrets in other variables of the shell do not get into a file that all users can read."""
    shell = {"ROS_DOMAIN_ID": "1", "RMW_IMPLEMENTATION": "x", "PATH": "/bin", "ROSRM_KEYS": "/k",
             "RCUTILS_LOGGING_USE_STDOUT": "1", "RCL_ASSERT_RMW_ID_MATCHES": "x",
             "ZENOH_ROUTER_CONFIG_URI": "/z", "ROSRM_INSTANCE": "a#1",
             "TOKEN": "secret"}  # fmt: skip
    assert set(shell) - set(needed_variables(shell)) == {"ROSRM_INSTANCE", "TOKEN"}


def test_a_line_break_begins_no_setting():
    """A variable of several lines is refused."""
    with pytest.raises(ConfigError, match="control characters"):
        unit_text("master", ["/bin/rosrm"], {"ROS_X": "1\nExecStart=/bin/other"}, None)


def test_the_command_of_a_unit_runs_from_any_directory(tmp_path):
    """The first words of ExecStart are absolute, with `python -m` as well."""
    printed = subprocess.run(
        [sys.executable, "-m", "rosrm.cli", "service", "install", "master", "--user", "--dry-run"],
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    (line,) = [one for one in printed.splitlines() if one.startswith("ExecStart=")]
    words = [word.strip('"') for word in line.removeprefix("ExecStart=").split()]
    assert words == [sys.executable, "-m", "rosrm.cli", "master"]
    shown = subprocess.run(
        [*words[:-1], "--version"], cwd=tmp_path, capture_output=True, timeout=60, check=False
    )
    assert shown.returncode == 0


def test_the_settings_on_the_page_of_limits_are_those_of_the_unit():
    """A unit of one's own, as the page shows it, delegates as much as the one that is written."""
    page = Path(__file__).parents[3] / "docs/how-to/enforced-limits.md"
    shown = re.search(r"```ini\n\[Service\]\n(.*?)```", page.read_text("utf-8"), re.DOTALL)[1]
    assert set(shown.splitlines()) < set(unit_text("slave", ["/r"], {}, "root").splitlines())
