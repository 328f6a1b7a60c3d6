"""`rosrm launch`, with a stored model in place of the resolver."""

from __future__ import annotations

import pytest
import yaml

from rosrm.model.applications import ApplyResult
from rosrm_launch import running
from rosrm_launch.model import LaunchModel
from tests.launch_files import stored


@pytest.fixture
def launch(tmp_path, monkeypatch, rosrm):
    """Run the command on a launch file whose model is stored, and note what the resolver gets."""
    asked = []

    def resolve(file, arguments, **options):
        asked.append((file.name, arguments, options))
        return LaunchModel.model_validate(stored(file.name))

    monkeypatch.setattr(running, "resolve", resolve)
    monkeypatch.chdir(tmp_path)

    def run(name, *words):
        (tmp_path / name).write_text("")
        return rosrm("launch", name, *words)

    run.asked = asked
    return run


def test_yaml_is_the_work_file_that_would_be_applied(launch):
    """Standard output has the work file alone; notes and omissions go to standard error."""
    result = launch("events.launch.py", "--yaml", "--app", "fleet", "speed:=2")
    work = yaml.safe_load(result.out)
    assert (result.code, work["app"], work["group"]["ends_with"]) == (0, "fleet", ["main"])
    assert "rosrm: not translated: " in result.err
    assert "OnProcessIO" in result.err
    assert launch.asked == [
        ("events.launch.py", ["speed:=2"], {"timeout": 60.0, "show_arguments": False})
    ]


def test_strict_refuses_what_cannot_be_translated(launch):
    result = launch("events.launch.py", "--yaml", "--strict")
    assert (result.code, result.out) == (2, "")
    assert "--strict refuses what cannot be translated, as listed above" in result.err


def test_a_dry_run_shows_hosts_and_begins_nothing(launch, client, monkeypatch):
    """The dry run is a plan of `rosrm apply`, with the same exit code."""
    targets = []

    def apply(sent, *, plan_only=False):
        targets.append((sent, plan_only))
        return ApplyResult("tools version 1: 2 processes to start", ())

    monkeypatch.setattr(type(client), "apply", staticmethod(apply), raising=False)
    result = launch("tools.launch.yaml", "--dry-run")
    assert (result.code, result.out) == (0, "tools version 1: 2 processes to start\n")
    (((target,), plan_only),) = targets
    assert (target.application, plan_only) == ("tools", True)


def test_the_arguments_of_a_file_are_listed(launch):
    result = launch("talkers.launch.py", "--show-args")
    assert "talkers:=  (default: '2')\n    Number of talkers\n" in result.out
    assert "mode:=  (default: 'slow'; one of slow, fast)" in result.out


def test_settings_beside_the_file_are_found(launch, tmp_path):
    (tmp_path / "tools.rosrm.yaml").write_text("nodes: {pause: {priority: 3}}")
    result = launch("tools.launch.yaml", "--yaml")
    assert yaml.safe_load(result.out)["processes"][1]["priority"] == 3
    other = tmp_path / "other.yaml"
    other.write_text("nodes: {nothing: {}}")
    result = launch("tools.launch.yaml", "--with", other)
    assert "other.yaml:1:9: nodes: no process or node is 'nothing'" in result.err
