"""Commands on applications: apply, history and revert."""

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

FIRST = VersionRow(1, 1_700_000_000.0, "user:ada", 2)
SECOND = VersionRow(2, 1_700_000_010.0, "user:ada", 2, wanted=True)
PAUSED = ApplicationRow(
    "nav", "user:ada", "paused", 2, 2, 1, reason="p: it does not run well: exit code 1",
    versions=(FIRST, SECOND),
)  # fmt: skip


@pytest.fixture
def work(tmp_path):
    path = tmp_path / "nav.yaml"
    path.write_text("app: nav\nprocesses: [{name: p, command: x}]\n")
    return path


@pytest.mark.parametrize(
    ("row", "note"),
    [
        (PAUSED, "desired, paused: p: it does not run well: exit code 1"),
        (replace(PAUSED, state="applying", reason=""), "desired, applying"),
        (replace(PAUSED, state="running", reason=""), "desired\n"),
    ],
)
def test_history_says_how_the_desired_version_stands(rosrm, client, row, note):
    """A version that is paused halfway is no desired state that was reached."""
    client.applications = [row]
    assert note in rosrm("history", "nav").out


def test_a_revert_without_a_version_to_return_to_says_so(rosrm, client):
    """The message names no option that was not given."""
    given_up = replace(FIRST, given_up="p: it failed")
    client.applications = [replace(PAUSED, versions=(given_up, SECOND))]
    result = rosrm("revert", "nav")
    assert result.code == 2
    assert result.err.startswith("rosrm: nav has no version before 2 that was not given up. `ros")


@pytest.mark.parametrize(
    "row",
    [
        replace(PAUSED, state="running", version=3, reason=""),
        replace(PAUSED, state="cancelled", version=0, reason=""),
    ],
    ids=["applied", "cancelled"],
)
def test_an_apply_that_another_request_replaces_says_so(rosrm, client, row, work):
    """The running processes are not those of the file."""
    replaced = PlannedAction("p", Action.REPLACE, "nav", version=2)
    client.applications = [row]
    client.apply = lambda *_, **__: ApplyResult("nav version 2: 1 process to replace", (replaced,))
    result = rosrm("apply", work)
    assert result.code == 1
    assert "another request has replaced version 2" in result.err


def test_an_apply_of_the_version_that_returned_succeeds(rosrm, client, work):
    """A newer version was given up before, which this request did not want."""
    third = VersionRow(3, 1_700_000_020.0, "user:ada", 2, given_up="p: it failed")
    client.applications = [
        replace(PAUSED, state="running", reason="", versions=(FIRST, SECOND, third))
    ]
    client.apply = lambda *_, **__: ApplyResult("nav is at version 2: nothing changes")
    result = rosrm("apply", work)
    assert (result.code, result.err) == (0, "")


def test_an_apply_ends_when_a_process_of_a_first_version_finds_no_host(rosrm, client, work):
    """Without a time-out, too: the application is degraded, and the reason is that of `apps`."""
    why = "p is set aside: no host may take it: no host offers the container engine podman"
    client.applications = [
        replace(PAUSED, state="degraded", version=1, versions=(FIRST,), reason=why)
    ]
    client.apply = lambda *_, **__: ApplyResult("nav version 1: 1 process to start")
    result = rosrm("apply", work)
    assert (result.code, result.err) == (1, f"rosrm: nav is degraded at version 1: {why}\n")


def test_the_end_of_the_time_for_an_apply_is_said(rosrm, client, work):
    """The application is still under way then."""
    client.applications = [replace(PAUSED, state="applying", reason="", pending={"p": "it starts"})]
    client.apply = lambda *_, **__: ApplyResult("nav version 2: 1 process to start")
    result = rosrm("apply", work, "--timeout", "1ms")
    assert result.code == 1
    assert "rosrm: --timeout has passed: nav is applying at version 2: p: it starts" in result.err
