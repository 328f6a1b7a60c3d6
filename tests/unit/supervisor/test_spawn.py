"""Starts of processes that cannot work; the supervisor survives each of them."""

from __future__ import annotations

import os

import pytest

from rosrm.supervisor.spawn import SpawnError, find_executable, spawn


@pytest.mark.parametrize(
    ("argv", "environment", "directory", "said"),
    [
        (("true",), {"PATH": "/bin"}, "/no/such", "working directory '/no/such' cannot be entered"),
        (("true",), {"PATH": "/bin"}, "/tmp/\0", "working directory .* cannot be entered"),
        (("true",), {"PATH": "/bin"}, "/\ud800", "working directory .* cannot be entered"),
        (("/no/such",), {}, "/", "no executable '/no/such' exists"),
        (("true", "\0"), {"PATH": "/bin"}, "/", "'true' cannot be started: embedded null"),
        (("true", "\ud800"), {"PATH": "/bin"}, "/", "'true' cannot be started: .* encode"),
    ],
)
def test_an_impossible_start_is_explained(argv, environment, directory, said):
    null = os.open(os.devnull, os.O_RDWR)
    try:
        with pytest.raises(SpawnError, match=said):
            spawn(argv, environment, directory, null, null)
    finally:
        os.close(null)


def test_a_program_that_was_removed_is_searched_for_again(tmp_path):
    """A path that was found a moment ago is not returned if nothing is there any more."""
    places = [tmp_path / "first", tmp_path / "second"]
    for place in places:
        place.mkdir()
        (place / "tool").touch(0o700)
    environment = {"PATH": f"{places[0]}:{places[1]}"}
    assert find_executable("tool", environment) == str(places[0] / "tool")
    (places[0] / "tool").unlink()
    assert find_executable("tool", environment) == str(places[1] / "tool")
