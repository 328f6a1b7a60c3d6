"""`rosrm apply --as-planned`: a kept plan, compared with the plan of now and with the result."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.model.applications import Action, ApplicationRow, ApplyResult, PlannedAction
from rosrm.ros.spec_digests import digest_of

from .conftest import process

START = PlannedAction("a", Action.START, "nav", "alpha")
REPLACE = PlannedAction("b", Action.REPLACE, "nav", "beta", "beta", fields=("command",))


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
    client.applications = [ApplicationRow("nav", "", "running", 1, 2, 2)]

    def apply(targets, *, plan_only=False):
        client.asked.append(
            ("plan" if plan_only else "apply", [one.application for one in targets])
        )
        return ApplyResult("nav version 1", client.actions, digest_of(targets))

    client.apply = apply
    return client


@pytest.fixture
def kept(master, rosrm, work, tmp_path):
    """Return the path of a plan that was kept."""
    result = rosrm("apply", str(work), "--plan", "--json")
    assert result.code == 2
    path = tmp_path / "nav.plan"
    path.write_text(result.out)
    master.asked.clear()
    return path


def requests(master):
    return [one[0] for one in master.asked if one[0] in ("plan", "apply")]


def test_a_plan_that_holds_is_applied(master, rosrm, work, kept):
    """The output is that of each apply."""
    result = rosrm("apply", str(work), "--as-planned", str(kept))
    assert (result.code, result.err) == (0, "")
    assert result.out == "nav version 1\nnav is running at version 1\n"
    assert requests(master) == ["plan", "apply"]


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
def test_a_plan_of_other_actions_begins_nothing(master, rosrm, work, kept, actions, said):
    """The refusal names each process whose action differs."""
    master.actions = actions
    result = rosrm("apply", str(work), "--as-planned", str(kept))
    assert result.code == 1
    assert result.err == (
        f"rosrm: other actions are needed now than at the time of the plan: {said}. Plan again. "
        f"Nothing was changed\n"
    )
    assert requests(master) == ["plan"]


def test_a_plan_of_other_work_begins_nothing(master, rosrm, work, kept):
    """A change of a value that the actions do not show is found, too."""
    work.write_text(work.read_text().replace("command: x", "command: z"))
    result = rosrm("apply", str(work), "--as-planned", str(kept))
    assert (result.code, requests(master)) == (1, ["plan"])
    assert "the work differs from that of the plan; plan again" in result.err


def test_what_other_readings_change_is_said(master, rosrm, work, kept):
    """Hosts, waits and moves of other processes: before the work begins, and at its end."""
    move = PlannedAction("other", Action.MOVE, "", "beta", "alpha")
    master.actions = (replace(START, host="beta"), replace(REPLACE, waits="no room"), move)
    master.processes = [process("a", host="gamma"), process("b", host="beta")]
    result = rosrm("apply", str(work), "--as-planned", str(kept))
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
def test_a_file_that_is_no_plan_is_refused(master, rosrm, work, tmp_path, text, said):
    """The error names the command that writes a plan."""
    path = tmp_path / "bad.plan"
    if text is not None:
        path.write_text(text)
    result = rosrm("apply", str(work), "--as-planned", str(path))
    assert (result.code, requests(master)) == (2, [])
    assert f"--as-planned: {path}: " in result.err
    assert said in result.err
    assert "`rosrm apply WORK --plan --json > FILE` writes a plan" in result.err
