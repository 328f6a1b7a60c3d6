"""Search for the program of a command line."""

from __future__ import annotations

from pathlib import Path

from rosrm.supervisor.spawn import find_executable


def test_a_program_that_was_removed_is_searched_for_again(tmp_path: Path) -> None:
    """A path that was found a moment ago is not returned if nothing is there any more."""
    places = [tmp_path / "first", tmp_path / "second"]
    for place in places:
        place.mkdir()
        (place / "tool").touch(0o700)
    environment = {"PATH": f"{places[0]}:{places[1]}"}
    assert find_executable("tool", environment) == str(places[0] / "tool")
    (places[0] / "tool").unlink()
    assert find_executable("tool", environment) == str(places[1] / "tool")
