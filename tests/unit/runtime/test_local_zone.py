"""Time zone of the machine."""

from __future__ import annotations

import os

import pytest

from rosrm.runtime import local_zone as module
from rosrm.runtime.local_zone import local_zone


@pytest.mark.parametrize(
    ("variable", "zone"),
    [
        ("Asia/Tokyo", "Asia/Tokyo"), (":Asia/Tokyo", "Asia/Tokyo"), ("CET-1CEST", "Asia/Tokyo"),
        ("", "Asia/Tokyo"),
    ],
)  # fmt: skip
def test_the_zone_is_that_of_tz_or_of_the_system(monkeypatch, tmp_path, variable, zone) -> None:
    """A zone without a name does not count."""
    monkeypatch.setenv("TZ", variable)
    link = tmp_path / "localtime"
    link.symlink_to("/usr/share/zoneinfo/Asia/Tokyo")
    monkeypatch.setattr(module, "_RULES", link)
    assert local_zone() == zone


@pytest.mark.parametrize(("text", "zone"), [("Asia/Tokyo\n", "Asia/Tokyo"), (None, "UTC")])
def test_a_machine_with_a_copy_of_the_rules_names_its_zone_in_a_file(
    monkeypatch, tmp_path, text, zone
) -> None:
    """Without that file the zone is UTC."""
    monkeypatch.delenv("TZ", raising=False)
    for name, content in (("localtime", "TZif"), ("timezone", text)):
        if content is not None:
            (tmp_path / name).write_text(content)
    monkeypatch.setattr(module, "_RULES", tmp_path / "localtime")
    monkeypatch.setattr(module, "_NAME", tmp_path / "timezone")
    assert local_zone() == zone
    assert os.environ.get("TZ") is None
