"""Time zone of the machine."""

from __future__ import annotations

import os
import time
from datetime import datetime
from pathlib import Path

import pytest

from rosrm.model.schedules import _zone
from rosrm.runtime import local_zone as module
from rosrm.runtime.local_zone import local_zone

DATABASE = Path("/usr/share/zoneinfo")
BERLIN = "CET-1CEST,M3.5.0,M10.5.0/3"
#: Two winters and two summers.
TIMES = (1.70e9, 1.72e9, 1.735e9, 1.75e9)


@pytest.fixture
def system(monkeypatch, tmp_path):
    """Set the zone of the system: a link, or a copy with the name of a zone beside it."""
    monkeypatch.delenv("TZ", raising=False)
    monkeypatch.setattr(module, "_RULES", tmp_path / "localtime")
    monkeypatch.setattr(module, "_NAME", tmp_path / "timezone")
    return tmp_path


@pytest.fixture
def offsets(monkeypatch):
    """Return the offsets that the C library has with a value of TZ."""

    def offsets_of(variable: str) -> list[int]:
        monkeypatch.setenv("TZ", variable)
        time.tzset()
        return [time.localtime(one).tm_gmtoff for one in TIMES]

    yield offsets_of
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize(
    "text",
    [
        "Asia/Tokyo", ":Asia/Tokyo", f":{DATABASE}/Asia/Tokyo", f"{DATABASE}/Asia/Tokyo", BERLIN,
        "CET-1CEST", "JST-9", "<+0330>-3:30",
        "EST5EDT", "UTC0", "", "no zone", "/no/file", "Asia/Nowhere",
    ],
)  # fmt: skip
def test_tz_is_read_as_the_c_library_reads_it(system, offsets, text) -> None:
    """A schedule and `date` agree, whatever form TZ has."""
    (system / "localtime").symlink_to(DATABASE / "Asia/Kolkata")
    known = offsets(text)
    zone = _zone(local_zone())
    assert [datetime.fromtimestamp(one, zone).utcoffset().seconds for one in TIMES] == [
        one % 86400 for one in known
    ]


def test_the_zone_of_the_system_is_the_name_of_its_link(system) -> None:
    """Without TZ the link of the system counts."""
    (system / "localtime").symlink_to(DATABASE / "Asia/Tokyo")
    assert local_zone() == "Asia/Tokyo"
    assert os.environ.get("TZ") is None


@pytest.mark.parametrize(
    ("rules", "stated", "zone"),
    [
        ("Asia/Kolkata", "America/New_York\n", "Asia/Kolkata"),
        ("Europe/Rome", "Europe/Vatican\n", "Europe/Vatican"),
    ],
)
def test_a_copy_of_the_rules_is_named_by_its_rules(system, rules, stated, zone) -> None:
    """A file with another name beside it, which the C library does not read, changes no zone."""
    (system / "localtime").write_bytes((DATABASE / rules).read_bytes())
    (system / "timezone").write_text(stated)
    assert local_zone() == zone


def test_rules_without_a_name_are_used(system) -> None:
    """A zone that the database does not have is given by its rules."""
    rules = (DATABASE / "Europe/Berlin").read_bytes().replace(b"M10.5.0/3", b"M10.4.0/3")
    (system / "localtime").write_bytes(rules)
    assert local_zone() == "CET-1CEST,M3.5.0,M10.4.0/3"


@pytest.mark.parametrize(("text", "zone"), [("Asia/Tokyo\n", "Asia/Tokyo"), (None, "UTC")])
def test_a_damaged_copy_is_named_by_the_file_beside_it(system, text, zone) -> None:
    """Without that file the zone is UTC."""
    (system / "localtime").write_text("TZif")
    if text is not None:
        (system / "timezone").write_text(text)
    assert local_zone() == zone


def test_a_machine_without_a_zone_has_utc(system) -> None:
    """The C library reads such a variable in the same way."""
    assert local_zone() == "UTC"
