"""The figures' own parts that need no cluster."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.paper import fig6, fig8, fig9, pictures, table3
from benchmarks.paper.judging import Line
from benchmarks.paper.page import section, update_page
from benchmarks.paper.report import FIGURES
from benchmarks.paper.settings import HOLDER_MB, MEMORY_LIMIT, host_settings
from benchmarks.paper.slam import Piece, pieces_of, shared_out
from benchmarks.paper.trace import Happening, HostLook, Look, Trace
from rosrm.config.host import load_host
from rosrm.config.work import load_work
from rosrm.errors import RosrmError
from rosrm.lab import GIB
from rosrm_examples.errors import DriveError

ROOT = Path(__file__).resolve().parents[3]


@given(st.lists(st.integers(20, 2000), min_size=1, max_size=10), st.integers(10, 30))
def test_pieces_are_shared_out_so_that_the_longest_is_short(scans, pieces):
    """No other cut has a shorter longest piece: one less for any makes it as long at least."""
    counts = shared_out(scans, pieces)
    assert sum(counts) == pieces
    assert min(counts) >= 1
    longest = max(length / count for length, count in zip(scans, counts, strict=True))
    for length, count in zip(scans, counts, strict=True):
        assert count == 1 or length / (count - 1) >= longest - 1e-9


@pytest.mark.parametrize(
    ("drives", "said"),
    [
        (["street:24"] * 4, "4 drives are too many for 3 pieces"),
        (["street:5"], "can be cut into at most 2 pieces, not 3"),
        (["nowhere.npz"], "no such file"),
    ],
)
def test_drives_that_cannot_be_cut_are_refused(drives, said):
    """Before any host is made."""
    with pytest.raises(DriveError, match=said):
        pieces_of(drives, 3)


def test_the_job_is_one_that_rosrm_takes(tmp_path):
    """As a work file, and with a name for each piece."""
    pieces = pieces_of(("street:24",), 3)
    assert [piece.number for piece in pieces] == [1, 2, 3]
    work = {"processes": [piece.entry(tmp_path, tmp_path) for piece in pieces]}
    (tmp_path / "work.yaml").write_text(json.dumps(work))
    specs = load_work(tmp_path / "work.yaml")
    assert [spec.name for spec in specs] == ["street_24_01", "street_24_02", "street_24_03"]
    assert specs[0].ros
    assert Piece("a/kitti 1.npz", 2, 3).name == "kitti_1_02"


def test_the_hosts_settings_are_the_papers(tmp_path):
    """Memory up to 80 %, CPU and disk without a limit, 10 Hz."""
    (tmp_path / "host.yaml").write_text(json.dumps(host_settings("host1")))
    settings = load_host(tmp_path / "host.yaml")
    assert dict(settings.limits) == {"memory": MEMORY_LIMIT, "cpu": 1.0, "disk": 1.0}
    assert settings.rate == 10.0


def test_fig6_overfills_the_hosts_with_8_to_80_mb():
    """By the same sizes in every run."""
    chosen = fig6.sizes(GIB)
    assert chosen == fig6.sizes(GIB)
    assert min(chosen) >= 8
    assert max(chosen) <= 80
    assert sum(chosen) + HOLDER_MB * len(chosen) > 3 * MEMORY_LIMIT * GIB / 1e6


# --- claims ---------------------------------------------------------------------------------------


def test_fig6_does_not_hold_when_hosts_could_take_more():
    """Something waits although there is room."""
    hosts = {f"host{n}": HostLook(0.3, 0.0, 1e9, accepting=True) for n in (1, 2, 3)}
    trace = Trace(looks=[Look(0.0, hosts, {"a": "queued"})])
    wrong, _ = fig6.judge(trace, {"a": 1e7})
    assert wrong == ["a waits, and host1, host2, host3 has room for it"]


def test_fig8_holds_for_a_line_only():
    """The bound is on R2, and the queue must not have run dry."""
    trace = Trace(looks=[Look(0.0, {}, {"a": "queued"})])
    assert fig8.judge(trace, [8, 16, 24], Line(8.0, 0.0, 1.0))[0] == []
    assert "R2 is 0.99000" in fig8.judge(trace, [8, 16, 22], Line(7.0, 1.0, 0.99))[0][0]
    dry = Trace(looks=[Look(0.0, {}, {"a": "running"})])
    assert "queue became empty" in fig8.judge(dry, [8, 16], Line(8.0, 0.0, 1.0))[0][0]


def test_fig9_holds_below_the_papers_slope_only():
    """And only while all slaves are within one cycle."""
    points = [{"slaves": 10, "ms": 0.2}, {"slaves": 1000, "ms": 20.0}]
    wrong, figures = fig9.judge(points, points, Line(0.02, 0.0, 1.0))
    assert (wrong, figures["slope_us"]) == ([], 20.0)
    assert "the paper: 84.3" in fig9.judge(points, points, Line(0.09, 0.0, 1.0))[0][0]
    assert "does not describe" in fig9.judge(points, points, Line(0.02, 0.0, 0.5))[0][0]
    slow = [{"slaves": 1000, "ms": 120.0}]
    assert "of a cycle of 100 ms" in fig9.judge(points, slow, Line(0.02, 0.0, 1.0))[0][0]


def spent(*counts):
    return [{"per_host": {f"host{n}": count for n, count in enumerate(counts)}}]


def test_table3_is_judged_by_the_medians():
    """One slow run does not count; a ratio above 1.05 does."""
    seconds = {"one_host": [100.0] * 3, "ideal": [10.0] * 3, "rosrm": [10.2, 10.3, 30.0]}
    wrong, figures = table3.judge(seconds, spent(1, 1), 10)
    assert wrong == []
    assert (figures["one_host_s"], figures["ideal_s"], figures["rosrm_s"]) == (100.0, 10.0, 10.3)
    assert figures["ratio"] == 1.03
    slow = {**seconds, "rosrm": [10.6, 10.6, 10.6]}
    assert "1.060 times" in table3.judge(slow, spent(1, 1), 10)[0][0]


def test_table3_does_not_hold_when_pieces_share_a_host():
    """Then it was not one piece a host."""
    seconds = {"one_host": [100.0], "ideal": [10.0], "rosrm": [10.0]}
    assert "shared a host" in table3.judge(seconds, spent(2, 0), 10)[0][0]


# --- pictures and arguments -----------------------------------------------------------------------


def test_every_form_of_picture_is_drawn(tmp_path):
    """A host that is not there yet leaves a gap, no error."""
    host = HostLook(0.3, 0.0, 1e9, accepting=True)
    trace = Trace(
        looks=[Look(0.0, {"host1": host}, {}), Look(1.0, {"host1": host, "host2": host}, {})],
        events=[Happening(1, 0.5, 0.0, "assigned", "a", "host1")],
    )
    pictures.usage(tmp_path / "1.png", trace, 0.8, joins=[0.5])
    pictures.processes(tmp_path / "2.png", [1, 2], [8, 16], Line(8.0, 0.0, 1.0))
    points = ([1, 10], [0.1, 0.3])
    pictures.cycle_times(tmp_path / "3.png", points, points, Line(0.02, 0.1, 1.0), Line(0.08, 0, 1))
    pictures.execution_times(tmp_path / "4.png", {"one": 10.0, "ten": 1.0})
    for number in range(1, 5):
        assert (tmp_path / f"{number}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "said"),
    [(["fig5"], "invalid choice: 'fig5'"), (["table3", "--runs", "0"], "at least 1")],
)
def test_bad_arguments_are_refused(words, said, tmp_path):
    """In argparse's way, with status 2."""
    ended = subprocess.run(
        [sys.executable, "-m", "benchmarks.paper", *words, "--out", str(tmp_path / "out")],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert ended.returncode == 2
    assert said in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "out").exists()


# --- the page -------------------------------------------------------------------------------------


def fig8_report(**changes):
    return {
        "claim": "c", "claim_holds": True, "against_it": [], "slaves": [1, 2], "processes": [8, 16],
        "r2": 1.0, "over_limit_percent": {"host2": 84.0}, "runs": 1, "seconds": 9.0,
        "load_average_before": 0.1,
        "machine": {"cores": 2, "processor": "P"}, **changes,
    }  # fmt: skip


def test_the_page_gets_what_was_measured_and_keeps_the_rest(tmp_path):
    """Written twice it is the same; a figure without a result stays as it is."""
    page = tmp_path / "page.md"
    marked = "".join(f"<!-- {name} -->\nold\n<!-- /{name} -->\n" for name in FIGURES)
    page.write_text(f"before\n{marked}end\n")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "fig8.json").write_text(json.dumps(fig8_report()))
    assert update_page(page, tmp_path / "results") == ["fig8"]
    once = page.read_text()
    assert update_page(page, tmp_path / "results") == ["fig8"]
    assert page.read_text() == once
    assert once.startswith("before\n<!-- fig6 -->\nold\n<!-- /fig6 -->\n<!-- fig7 -->\nold\n")
    assert "![fig8: c](results/fig8.png)" in once
    assert "| processes held | proportional | 8, 16 |" in once
    assert "| slaves that passed 80 %, and the highest |  | 1, 84.0 % |" in once
    assert "The claim holds." in once


def test_a_claim_that_does_not_hold_is_said(tmp_path):
    """With the reasons."""
    said = section("fig8", fig8_report(claim_holds=False, against_it=["R2 is low"]), "p.png")
    assert "**The claim does not hold:** R2 is low" in said


def test_a_page_without_the_marks_is_refused(tmp_path):
    """What was measured must not get lost silently."""
    (tmp_path / "page.md").write_text("nothing")
    (tmp_path / "fig8.json").write_text(json.dumps(fig8_report()))
    with pytest.raises(RosrmError, match="no marks '<!-- fig6 -->'"):
        update_page(tmp_path / "page.md", tmp_path)


def test_the_documentation_has_a_place_for_each_figure():
    """And a picture's marks for nothing else."""
    marks = re.findall(
        r"^<!-- (/?\w+) -->$", (ROOT / "docs/evaluation.md").read_text(), re.MULTILINE
    )
    assert marks == [mark for name in FIGURES for mark in (name, f"/{name}")]
