"""The page of a report: self-contained, escaped, bounded."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

from rosrm.timeline.values import Placement
from rosrm_report import svg
from rosrm_report.extract import report_of
from rosrm_report.model import Material, Readings, Report
from rosrm_report.page import MOST_ROWS, page_of
from tests.unit.tools.report.runs import BEGAN, READINGS, decision, events, report

HOSTILE = "<script>alert('x')</script>\"'&\x00 http://evil.example/x"
#: Attributes that load something, or run a script.
_LOADING = ("src", "srcset", "data", "action", "background", "poster", "xlink:href", "formaction")


class Page(HTMLParser):
    """The elements and texts of a page; raises if its elements do not nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag != "meta":  # the one element without an end tag here
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for one, attributes in self.tags if one == tag]


def hostile() -> Report:
    """Return a run in which every text of a user is hostile."""
    name = HOSTILE
    moved = {"from": "a" + name, "to": "b" + name, "cause": name, "strategy": name, "seconds": 1}
    lines = [
        (0, "submitted", name), (0, "waits", name, "", name),
        (1, "assigned", name, "a" + name, name, {
            "decision": {"hosts": [{"name": "a" + name, "score": 1.0}, {"name": name, "score": 1}]}
        }),
        (2, "running", name, "a" + name), (3, "migrated", name, "b" + name, name, moved),
        (4, "over_limit", "", "b" + name, name, {"resource": name}),
        (5, "host_lost", "", "b" + name, name), (6, "failed", name, "b" + name, name),
    ]  # fmt: skip
    readings = Readings((0.0, 1.0), {name: {"a" + name: (0.1, 0.2)}}, {name: {"a" + name: 0.5}})
    made = report_of(Material(name, events(*lines), readings, (name,)), name)
    return replace(made, failures=(replace(made.failures[0], lines=(name,)),))


def test_hostile_text_is_text():
    """Names, messages, log lines and resources add no element and no attribute."""
    page = Page(page_of(hostile()))

    assert page.named("script") == []
    assert not [one for _, attributes in page.tags for one in attributes if one.startswith("on")]
    assert "\x00" not in "".join(page.texts)
    assert sum("<script>alert('x')</script>" in one for one in page.texts) > 20


def test_nothing_is_loaded():
    """The page refers to itself alone, and its policy forbids everything else."""
    text = page_of(hostile())
    page = Page(text)

    for tag, attributes in page.tags:
        assert tag not in ("link", "img", "iframe", "object", "embed", "base", "image", "use")
        assert not set(_LOADING) & set(attributes)
        assert (attributes.get("href") or "#").startswith("#")
    (style,) = [one for one in page.texts if ":root" in one]
    assert "url(" not in style
    assert "@import" not in style
    policies = [one["content"] for one in page.named("meta") if "http-equiv" in one]
    assert policies == [
        "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    ]


def test_every_picture_has_a_text_and_every_link_its_target():
    """For readers who do not see the pictures; ids are unique."""
    page = Page(page_of(hostile()))
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]

    assert len(ids) == len(set(ids))
    pictures = page.named("svg")
    assert len(pictures) == 3
    for picture in pictures:
        assert picture["role"] == "img"
        assert set((picture["aria-labelledby"] or "").split()) <= set(ids)
    assert {one["href"] for one in page.named("a")} <= {f"#{one}" for one in ids}


def test_a_run_without_readings_has_no_picture_of_usage():
    """A sentence says so instead."""
    page = Page(page_of(report((0, "submitted", "p"), (1, "assigned", "p", "a"))))

    assert [one["id"] for one in page.named("svg")] == ["timeline", "queue-length"]
    assert any("The source has no readings" in one for one in page.texts)


def test_an_empty_run_has_a_page():
    """Nothing is divided by its length."""
    assert "No events" in page_of(report())


def test_a_giant_run_has_a_bounded_page():
    """The page says how much it leaves out; nothing with a time is left out of the numbers."""
    lines = []
    for n in range(20_000):
        host = f"h{n % 50}"
        lines.append((n, "submitted", f"p{n}"))
        lines.append((n, "assigned", f"p{n}", host, "", decision(**{host: 0.5, "other": 0.5})))
        lines.append((n + 0.5, "failed", f"p{n}", host, "m" * 5000, {}))
    usage = {"memory": {f"h{n}": tuple([0.5] * 20_000) for n in range(50)}}
    readings = Readings(tuple(float(n) for n in range(20_000)), usage, {"memory": {}})
    text = page_of(report(*lines, readings=readings))

    assert len(text) < 3_000_000
    assert "17000 bars are left out" in text
    assert f"{20_000 - MOST_ROWS} more are left out" in text
    assert "26 hosts with lower peaks are left out" in text


# --- pictures -----------------------------------------------------------------------------------


def test_processes_at_the_same_time_have_rows_of_their_own():
    """A process that begins when another ended takes its row."""
    bars = [Placement("p", "a", 0, 2), Placement("q", "a", 1, 3), Placement("r", "a", 2, 4)]
    text = svg.timeline(["a"], bars, [], [], [], 4.0).text
    rows = [one["y"] for one in Page(text).named("rect") if one["class"] == "c0"]

    assert rows == ["4.5", "13.5", "4.5"]


def test_a_thinned_curve_keeps_its_peak_and_its_gaps():
    """The highest of several points is drawn; an unknown time interrupts the curve."""
    values = [0.1] * 4000
    values[1234] = 0.97
    gap: list[float | None] = [None] * 500
    readings = Readings(
        tuple(map(float, range(4500))), {"cpu": {"a": (*values, *gap)}}, {"cpu": {}}
    )
    text = svg.usage(readings, "cpu", ["a"], 4500.0).text
    (curve,) = [one["d"] for one in Page(text).named("path")]

    assert curve is not None
    assert f"V{round(4 + 0.03 * 176, 1)}" in curve
    assert curve.count("M") == 1
    assert "a: at most 97 %" in text


def test_the_usage_of_each_resource_is_drawn_with_its_limit():
    """The limit of 80 % is a line."""
    picture = svg.usage(READINGS, "memory", ["a", "b"], 2.0)

    assert "limit 80 %" in picture.text
    assert picture.omitted == 0


def test_the_beginning_is_shown_in_utc():
    """Unix time without a zone would be read differently elsewhere."""
    assert BEGAN == 1.7e9
    assert "from 2023-11-14 22:13:20 UTC" in page_of(report((0, "submitted", "p")))
