"""Parts of the paper's figures that need no cluster."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.paper import __main__ as paper
from benchmarks.paper import fig6, fig8, fig9, fig10, fig11, page, pictures, table3
from benchmarks.paper.judging import Line
from benchmarks.paper.labs import Failed, LabClient, Part
from benchmarks.paper.page import section, update_page
from benchmarks.paper.repeated import combined
from benchmarks.paper.report import FIGURES, REPEATED, Options, Result
from benchmarks.paper.settings import HOLDER_MB, MEMORY_LIMIT, alike, host_settings
from benchmarks.paper.slam import Piece, pieces_of, shared_out
from benchmarks.paper.trace import Happening, HostLook, Look, Trace
from rosrm.config.host import load_host
from rosrm.config.work import load_work
from rosrm.errors import RosrmError
from rosrm_examples.errors import DriveError
from rosrm_lab import GIB, MIB, uniform

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
    """The refusal comes before any host is made."""
    with pytest.raises(DriveError, match=said):
        pieces_of(drives, 3)


def test_the_job_is_one_that_rosrm_takes(tmp_path):
    """The work file loads, and each piece has a name."""
    pieces = pieces_of(("street:24",), 3)
    assert [piece.number for piece in pieces] == [1, 2, 3]
    work = {"processes": [piece.entry(tmp_path, tmp_path) for piece in pieces]}
    (tmp_path / "work.yaml").write_text(json.dumps(work))
    specs = load_work(tmp_path / "work.yaml")
    assert [spec.name for spec in specs] == ["street_24_01", "street_24_02", "street_24_03"]
    assert specs[0].ros
    assert Piece("a/kitti 1.npz", 2, 3).name == "kitti_1_02"


def test_the_hosts_settings_are_the_papers(tmp_path):
    """Memory has a limit of 80 %, CPU and disk have none, at 10 Hz."""
    (tmp_path / "host.yaml").write_text(json.dumps(host_settings("host1")))
    settings = load_host(tmp_path / "host.yaml")
    assert dict(settings.limits) == {"memory": MEMORY_LIMIT, "cpu": 1.0, "disk": 1.0}
    assert settings.rate == 10.0


def test_fig6_overfills_the_hosts_with_8_to_80_mb():
    """The sizes are the same in every run."""
    chosen = fig6.sizes(GIB)
    assert chosen == fig6.sizes(GIB)
    assert min(chosen) >= 8
    assert max(chosen) <= 80
    assert sum(chosen) + HOLDER_MB * len(chosen) > 3 * MEMORY_LIMIT * GIB / 1e6


# --- claims ---------------------------------------------------------------------------------------


def test_fig6_does_not_hold_when_hosts_could_take_more():
    """A process waits although there is room."""
    hosts = {f"host{n}": HostLook(0.3, 0.0, 1e9, accepting=True) for n in (1, 2, 3)}
    trace = Trace(looks=[Look(0.0, hosts, {"a": "queued"})])
    wrong, _ = fig6.judge(trace, {"a": 1e7})
    assert wrong == ["a waits, and host1, host2, host3 has room for it"]


def test_fig6_does_not_hold_when_its_replay_decides_differently():
    """A record without any decision does not hold either."""
    alike = {"replayed_decisions": 60, "replayed_differently": 0}
    assert fig6.replayed_otherwise(alike) == []
    (wrong,) = fig6.replayed_otherwise({**alike, "replayed_differently": 1})
    assert wrong == "`rosrm simulate` decides 1 of the record's 60 differently"
    assert fig6.replayed_otherwise({**alike, "replayed_decisions": 0}) != []


ONE = Line(8.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("top", "state", "counts", "line", "said"),
    [
        (0.8, "queued", [8, 16, 24], ONE, None),
        (0.8, "queued", [8, *range(17, 90, 9)], Line(9.0, -1.0, 1.0), None),
        (0.8, "queued", [8, 16, 22], Line(7.0, 1.0, 0.99), "R2 is 0.99000"),
        (0.8, "running", [8, 16], ONE, "queue became empty"),
        # The first slave holds something else.
        (0.8, "queued", [28, 36, 44], Line(8.0, 20.0, 1.0),
         "not in proportion: R2 of the line through the origin"),
        (0.809, "queued", [8, 16], ONE, None),  # within the noise of a reading
        (0.84, "queued", [8, 16], ONE, "host1 reached 84.0 %"),
    ],
)  # fmt: skip
def test_fig8_holds_for_a_proportion_up_to_the_limit_only(top, state, counts, line, said):
    """The bound is on R2, and the queue must not have run dry."""
    host = HostLook(top, 0.0, 1e9, accepting=False)
    trace = Trace(looks=[Look(0.0, {"host1": host}, {"a": state})])
    wrong, _ = fig8.judge(trace, counts, line)
    assert wrong == [] if said is None else said in wrong[0]


KEPT_UP = {
    "slaves": 1000, "ms": 20.0, "offered_per_s": 9900.0, "received_per_s": 9890.0, "cycles": 59_400,
    "missed": 3, "hosts_heard": 1000, "masters_lost": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        ({"missed": 30_000}, "30000 of 59400 readings were missed"),
        ({"offered_per_s": 5000.0}, "5000.0 cycles a second instead of 10000 were carried out"),
        ({"received_per_s": 5000.0}, "5000.0 cycles a second instead of 10000 were received"),
        ({"hosts_heard": 999}, "of 1000 slaves 999 sent readings"),
        ({"masters_lost": 2}, "of 1000 slaves 2 took the master for lost"),
    ],
)
def test_fig9_counts_only_where_the_master_kept_up(changes, said):
    """A point is dropped where half of the readings were not made, or not received."""
    wrong = fig9.not_kept_up({**KEPT_UP, **changes})
    assert wrong == [] if said is None else (len(wrong) == 1 and said in wrong[0])


@pytest.mark.parametrize(
    ("point", "fitted", "line", "said"),
    [
        ({}, {}, Line(0.02, 0.0, 1.0), None),
        ({}, {}, Line(0.09, 0.0, 1.0), "the paper: 84.3"),
        ({}, {}, Line(0.02, 0.0, 0.5), "does not describe"),
        ({"missed": 59_000}, {}, Line(0.02, 0.0, 1.0), "59000 of 59400"),
        ({}, {"ms": 120.0}, Line(0.02, 0.0, 1.0), "of a cycle of 100 ms"),
    ],
)
def test_fig9_holds_below_the_papers_slope_only(point, fitted, line, said):
    """All slaves must be within one cycle, too."""
    wrong, figures = fig9.judge([{**KEPT_UP, **point}], [{**KEPT_UP, **fitted}], line)
    assert (wrong, figures["slope_us"]) == ([], 20.0) if said is None else said in wrong[0]


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


@pytest.mark.parametrize(
    ("one_host", "counts", "said"),
    [
        (100.0, (2, 0), "shared a host"),  # measured are not single pieces
        (30.0, (1, 1), "10 hosts are only 3.0 times as fast"),  # not in parallel
    ],
)
def test_table3_does_not_hold_where_hosts_do_not_work_in_parallel(one_host, counts, said):
    seconds = {"one_host": [one_host], "ideal": [10.0], "rosrm": [10.0]}
    assert said in table3.judge(seconds, spent(*counts), 10)[0][0]


def test_what_is_said_of_the_size_is_of_this_run():
    """The text has the hosts that were made, and the speed of the run."""
    plans = uniform(3, memory=256 * MIB, cpu=0.5)
    assert alike(plans) == "3 of 256 MiB and 0.5 cores each on one machine"
    usual, small = fig10.scaled(plans)["time"], fig10.scaled(plans, 3.0)["time"]
    assert usual.startswith("2.7 times")
    assert usual.endswith("5.5 MB a second, and come at 0, 33, 75 s")
    assert small.startswith("8.1 times")
    assert small.endswith("16.5 MB a second, and come at 0, 11, 25 s")


def test_several_runs_are_one_result_with_median_and_range():
    """The run with the median is drawn, and the objections to each run count."""
    drawn = []
    runs = [
        Result([f"wrong {x}"] if x > 4 else [], {"x": x, "y": -x}, {}, partial(drawn.append, x))
        for x in (5.0, 1.0, 3.0)
    ]
    one = combined(runs, ("x", "y"))
    assert (one.wrong, one.runs, one.figures["x"]) == (["run 1: wrong 5.0"], 3, 3.0)
    assert one.figures["spread"]["y"] == {
        "median": -3.0, "least": -5.0, "most": -1.0, "runs": [-5.0, -1.0, -3.0],
    }  # fmt: skip


@pytest.mark.parametrize("name", REPEATED)
def test_each_number_with_a_range_has_its_row_on_the_page(name):
    figure = importlib.import_module(f"benchmarks.paper.{name}")
    assert set(figure.SPREAD) <= set(page._SPREAD)


def test_fig11_is_judged_by_the_summary_of_the_demo(tmp_path, monkeypatch):
    """The picture is that of the demo; a demo without results is a failed measurement."""
    summary = {
        "drive": "street", "scans_sent": 9, "scans_processed": 9, "scans_lost": 0,
        "scans_repeated": 1, "migrations": 1, "gap_ms": 1.0, "max_deviation_m": 0.0,
        "parts": [{"host": "a", "scans": 9, "points": 1}],
    }  # fmt: skip

    def demo(command, **_):
        out = Path(command[command.index("--out") + 1])
        out.mkdir()
        (out / "summary.json").write_text(json.dumps(summary))
        (out / "map.png").write_bytes(b"map")
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(subprocess, "run", demo)
    result = fig11.measure(Options(tmp_path, small=True))
    assert result.wrong == ["scans_repeated is 1, not 0"]
    result.draw(tmp_path / "fig11.png")
    assert (tmp_path / "fig11.png").read_bytes() == b"map"
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 2))
    with pytest.raises(Failed, match="the demo ended with exit code 2"):
        fig11.measure(Options(tmp_path))


# --- failures -------------------------------------------------------------------------------------


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """Return a function that replaces the measurement of figure 9."""
    monkeypatch.setattr(paper, "raise_signals", lambda: None)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return lambda measure: monkeypatch.setattr(fig9, "measure", measure)


@pytest.mark.parametrize(
    "error",
    [
        subprocess.TimeoutExpired(["map"], 1500.0),
        BrokenPipeError("Broken pipe"),
        Failed("the client at the desk did not answer"),
    ],
)
def test_a_figure_that_fails_leaves_its_logs_and_no_old_numbers(error, measured, tmp_path, capsys):
    """The output has one line for the error and one for the logs; old numbers are removed."""
    folders = []

    def fail(options):
        folders.append(options.folder)
        (options.folder / "master.log").write_text("why")
        raise error

    measured(fail)
    out = tmp_path / "out"
    out.mkdir()
    (out / "fig9.json").write_text("{}")
    assert paper.main(["fig9", "--small", "--out", str(out)]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[1] == f"fig9: failed: {error}"
    assert said[2].endswith(f"are kept in {folders[0]}")
    assert (folders[0] / "master.log").read_text() == "why"
    assert list(out.iterdir()) == []


def test_a_figure_that_is_measured_says_its_size_and_leaves_no_folder(measured, tmp_path):
    """The numbers mark a small run."""
    result = Result([], {"slope_us": 1.0}, {"hosts": "few"}, lambda path: path.touch())
    measured(lambda _: result)
    out = tmp_path / "out"
    assert paper.main(["fig9", "--out", str(out), "--small"]) == 0
    report = json.loads((out / "fig9.json").read_text())
    assert (report["small"], report["claim_holds"]) == (True, True)
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("ends", ["before it is asked", "when it is asked"])
def test_a_desk_that_has_ended_is_told_with_its_last_words(ends, tmp_path):
    """The message has its exit code and log, before or after a question is written."""
    log = tmp_path / "desk.log"
    wait = "read line; " if ends == "when it is asked" else ""
    script = f"echo '{{}}'; {wait}echo no master >&2; exit 3"

    def start():
        with log.open("wb") as sink:
            process = subprocess.Popen(
                ["sh", "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=sink
            )
        return Part("the client at the desk", process, log)

    with LabClient(start, lambda: None) as desk:
        if ends == "before it is asked":
            desk._part.process.wait(30.0)
        with pytest.raises(Failed, match="desk ended with exit code 3:\n  no master"):
            desk.ask({"do": "look"})


# --- pictures and arguments -----------------------------------------------------------------------


def test_every_form_of_picture_is_drawn(tmp_path):
    """A host that has not joined yet leaves a gap, no error."""
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
    [
        (["fig5"], "invalid choice: 'fig5'"),
        (["table3", "--runs", "0"], "at least 1"),
        (["fig6", "--small", "--page", "page.md"], "--small measures nothing worth writing there"),
    ],
)
def test_bad_arguments_are_refused(words, said, tmp_path):
    """The error is argparse's, with status 2."""
    command = [sys.executable, "-m", "benchmarks.paper", *words, "--out", str(tmp_path / "out")]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 2
    assert said in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "out").exists()


# --- the page -------------------------------------------------------------------------------------


def fig8_report(**changes):
    return {
        "claim": "c", "claim_holds": True, "against_it": [], "slaves": [1, 2], "processes": [8, 16],
        "r2": 1.0, "r2_through_origin": 0.9995, "over_limit_percent": {"host2": 84.0},
        "runs": 1, "seconds": 9.0, "load_average_before": 0.1,
        "machine": {"cores": 2, "processor": "P"}, **changes,
    }  # fmt: skip


def test_the_page_gets_what_was_measured_and_keeps_the_rest(tmp_path):
    """A second update changes nothing; a figure that was not measured now stays unchanged."""
    page = tmp_path / "page.md"
    marked = "".join(f"<!-- {name} -->\nold\n<!-- /{name} -->\n" for name in FIGURES)
    page.write_text(f"before\n{marked}end\n")
    (tmp_path / "results").mkdir()
    for name in ("fig6", "fig8"):
        (tmp_path / "results" / f"{name}.json").write_text(json.dumps(fig8_report()))
    update_page(page, tmp_path / "results", ["fig8"])
    once = page.read_text()
    update_page(page, tmp_path / "results", ["fig8"])
    assert page.read_text() == once
    assert once.startswith("before\n<!-- fig6 -->\nold\n<!-- /fig6 -->\n<!-- fig7 -->\nold\n")
    assert "![fig8: c](results/fig8.png)" in once
    assert "| processes held | proportional | 8, 16 |" in once
    assert "| slaves that passed 80 %, and the highest |  | 1, 84.0 % |" in once
    assert "The claim holds." in once


def test_a_claim_that_does_not_hold_is_said(tmp_path):
    """The page has the reasons."""
    said = section("fig8", fig8_report(claim_holds=False, against_it=["R2 is low"]), "p.png")
    assert "**The claim does not hold:** R2 is low" in said


def test_a_page_without_the_marks_is_refused(tmp_path):
    """An update without marks would lose measurements silently."""
    (tmp_path / "page.md").write_text("nothing")
    (tmp_path / "fig8.json").write_text(json.dumps(fig8_report()))
    with pytest.raises(RosrmError, match="no marks '<!-- fig6 -->'"):
        update_page(tmp_path / "page.md", tmp_path, ["fig8"])


def test_the_documentation_has_a_place_for_each_figure():
    """A picture's marks are for figures only."""
    marks = re.findall(
        r"^<!-- (/?\w+) -->$", (ROOT / "docs/evaluation.md").read_text(), re.MULTILINE
    )
    assert marks == [mark for name in FIGURES for mark in (name, f"/{name}")]
