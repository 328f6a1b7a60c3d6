"""`--as-planned`: kept plans, compared with the plan of now and with the result."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.model.applications import (
    Action,
    ApplicationRow,
    ApplyResult,
    PlannedAction,
    VersionRow,
)
from rosrm.model.modes import ModeRow
from rosrm.ros.spec_digests import digest_of

from .conftest import process

START = PlannedAction("a", Action.START, "nav", "alpha")
REPLACE = PlannedAction("b", Action.REPLACE, "nav", "beta", "beta", fields=("command",))
RUNS = ApplicationRow(
    "nav", "", "running", 2, 2, 2, versions=tuple(VersionRow(n, 0.0, "", 2) for n in (1, 2))
)
DOCKED = ModeRow("docked", "in force", ("nav",), digest="one")
#: Last line of each command whose work is done.
ENDS = {
    "apply": "nav is running at version 2",
    "revert": "nav is running at version 2",
    "mode": "the mode docked is in force",
}


@pytest.fixture
def work(tmp_path):
    path = tmp_path / "nav.yaml"
    path.write_text("app: nav\nprocesses: [{name: a, command: x}, {name: b, command: y}]\n")
    return path


@pytest.fixture
def master(client):
    """Return the fake master, which plans `actions` and carries all out."""
    client.actions = (START, REPLACE)
    client.processes = [process("a", host="alpha"), process("b", host="beta")]
    client.applications, client.modes = [RUNS], [DOCKED]

    def apply(targets, *, plan_only=False):
        client.asked.append(("plan" if plan_only else "apply", targets))
        return ApplyResult("two actions", client.actions, digest_of(targets))

    def switch_mode(mode, *, plan_only=False):
        return replace(apply(mode, plan_only=plan_only), work="")

    client.apply, client.switch_mode = apply, switch_mode
    return client


@pytest.fixture(params=ENDS)
def command(request, work):
    """Return the words of each command that takes a kept plan."""
    arguments = {"apply": work, "revert": "nav", "mode": "docked"}
    return request.param, arguments[request.param]


@pytest.fixture
def kept(master, rosrm, command, tmp_path):
    """Return the path of a plan that was kept."""
    result = rosrm(*command, "--plan", "--json")
    assert result.code == 2
    path = tmp_path / "nav.plan"
    path.write_text(result.out)
    master.asked.clear()
    return path


def requests(master):
    return [one[0] for one in master.asked if one[0] in ("plan", "apply")]


def test_a_plan_that_holds_is_carried_out(master, rosrm, command, kept):
    """The output is that of the command without a plan, and both requests ask for the same."""
    result = rosrm(*command, "--as-planned", kept)
    assert (result.code, result.err) == (0, "")
    assert result.out == f"two actions\n{ENDS[command[0]]}\n"
    assert requests(master) == ["plan", "apply"]
    planned, applied = (one[1] for one in master.asked if one[0] in ("plan", "apply"))
    assert planned == applied


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        ((START,), "b: replace (changed: command) was planned, now no action"),
        ((replace(START, action=Action.STOP), REPLACE), "a: start was planned, now stop"),
        (
            (START, replace(REPLACE, fields=("command", "limits"))),
            "b: replace (changed: command) was planned, now replace (changed: command and limits)",
        ),
    ],
)
def test_a_plan_of_other_actions_begins_nothing(master, rosrm, command, kept, actions, said):
    """The refusal names each process whose action differs."""
    master.actions = actions
    result = rosrm(*command, "--as-planned", kept)
    assert result.code == 1
    assert result.err == (
        f"rosrm: other actions are needed now than at the time of the plan: {said}. Plan again. "
        f"Nothing was changed\n"
    )
    assert requests(master) == ["plan"]


def test_a_plan_of_other_work_begins_nothing(master, rosrm, work, command, kept):
    """A change of a value that the actions do not show is found, too.

    A revert is to the version before the desired one, and a mode may be loaded again.
    """
    work.write_text(work.read_text().replace("command: x", "command: z"))
    third = VersionRow(3, 0.0, "", 2)
    master.applications = [replace(RUNS, version=3, versions=(*RUNS.versions, third))]
    master.modes = [replace(DOCKED, digest="two")]
    result = rosrm(*command, "--as-planned", kept)
    assert (result.code, requests(master)) == (1, ["plan"])
    assert "the work differs from that of the plan; plan again" in result.err


@pytest.mark.parametrize(
    ("planned", "requested", "said"),
    [
        (("mode", "docked"), ("mode", "exploring"), "the mode docked|the mode exploring"),
        (("revert", "nav"), ("mode", "docked"), "applications|the mode docked"),
        (("mode", "docked"), ("revert", "nav"), "the mode docked|applications"),
    ],
)
def test_a_plan_of_another_mode_names_both(master, rosrm, tmp_path, planned, requested, said):
    """The refusal says which file was given by mistake."""
    master.modes = [DOCKED, replace(DOCKED, name="exploring", state="", digest="two")]
    kept = tmp_path / "kept.plan"
    kept.write_text(rosrm(*planned, "--plan", "--json").out)
    result = rosrm(*requested, "--as-planned", kept)
    assert (result.code, "apply" in requests(master)) == (1, False)
    this, other = said.split("|")
    assert result.err == (
        f"rosrm: the plan is one of {this}, and the request is one of {other}. Nothing was "
        f"changed\n"
    )


def test_what_other_readings_change_is_said(master, rosrm, command, kept):
    """Hosts, waits and moves of other processes: before the work begins, and at its end."""
    move = PlannedAction("other", Action.MOVE, "", "beta", "alpha")
    master.actions = (replace(START, host="beta"), replace(REPLACE, waits="no room"), move)
    master.processes = [process("a", host="gamma"), process("b", host="beta")]
    result = rosrm(*command, "--as-planned", kept)
    assert result.code == 0
    readings = "rosrm: other readings than at the time of the plan:"
    assert result.err.splitlines() == [
        f"{readings} a: start on alpha was planned, now start on beta",
        f"{readings} b: replace on beta was planned, now replace on beta, and a wait",
        f"{readings} other: no action was planned, now move from alpha to beta",
        "rosrm: other than planned: a is on gamma; beta was planned",
    ]


def test_an_application_that_is_no_longer_listed_is_not_as_described(master, rosrm, work):
    """For example after a loss of the journal: the command does not end with success."""
    master.applications = []
    result = rosrm("apply", str(work))
    assert (result.code, result.err) == (1, "rosrm: nav is no longer listed\n")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "No such file or directory"),
        ("nav version 1: 2 processes to start", "the file is not JSON"),
        ('{"actions": []}', "message is missing"),
        (
            '{"message": "", "actions": [{"process": "p", "action": "fly"}]}',
            "'fly'; allowed: start",
        ),
    ],
)
def test_a_file_that_is_no_plan_is_refused(master, rosrm, command, tmp_path, text, said):
    """The error says how to write a plan."""
    path = tmp_path / "bad.plan"
    if text is not None:
        path.write_text(text)
    result = rosrm(*command, "--as-planned", path)
    assert (result.code, requests(master)) == (2, [])
    assert f"--as-planned: {path}: " in result.err
    assert said in result.err
    assert "the same command with `--plan --json > FILE` writes a plan" in result.err


def test_a_kept_plan_of_no_mode_is_refused(master, rosrm, tmp_path):
    """The command without a mode only lists and loads modes."""
    result = rosrm("mode", "--as-planned", tmp_path / "kept")
    assert (result.code, master.asked) == (2, [])
    assert "give the mode, too: `rosrm mode NAME --as-planned`" in result.err
