"""Commands on applications: history and revert."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.model.applications import ApplicationRow, VersionRow

FIRST = VersionRow(1, 1_700_000_000.0, "user:ada", 2)
SECOND = VersionRow(2, 1_700_000_010.0, "user:ada", 2, wanted=True)
PAUSED = ApplicationRow(
    "nav", "user:ada", "paused", 2, 2, 1, reason="p: it does not run well: exit code 1",
    versions=(FIRST, SECOND),
)  # fmt: skip


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
