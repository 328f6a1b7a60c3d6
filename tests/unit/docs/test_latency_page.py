"""Table and picture of the page about the latency of a start."""

from __future__ import annotations

import json
from xml.etree import ElementTree as ET

import pytest

from rosrm.client.start_traces import BESIDE, STAMPS
from scripts import latency_page

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def report():
    return json.loads(latency_page.RESULT.read_text(encoding="utf-8"))


def test_the_page_and_the_picture_are_those_of_the_stored_result(report):
    """`python -m scripts.latency_page` writes both."""
    picture = latency_page.PICTURE.read_text(encoding="utf-8")
    assert picture == latency_page.picture(report["hand_overs"])
    assert latency_page.section(report) in latency_page.PAGE.read_text(encoding="utf-8")


def test_the_stored_result_has_every_hand_over(report):
    """A new stamp needs a new measurement."""
    assert [row["stamp"] for row in report["hand_overs"]] == [*STAMPS, *BESIDE]


def test_each_bar_begins_where_the_one_before_ends(report):
    """The whole width is the longest time; the texts are inside the picture."""
    root = ET.fromstring(latency_page.picture(report["hand_overs"]))
    _, *bars = root.findall(f"{SVG}rect")
    assert len(bars) == len(STAMPS) - 1
    ends = [float(bar.get("x")) + float(bar.get("width")) for bar in bars]
    for before, bar in zip(ends, bars[1:], strict=False):
        assert float(bar.get("x")) == pytest.approx(before, abs=1.1)
    width = float(root.get("viewBox").split()[2])
    assert all(0 <= float(text.get("x")) < width for text in root.findall(f"{SVG}text"))
