"""`rosrm simulate`."""

from __future__ import annotations

import json
import sys

import pytest
from rich.console import Console

from rosrm.cli.output import tables
from rosrm.core.master import invariants
from rosrm_simulate import picture
from rosrm_simulate.runs import SimulationRequest, carry_out
from tests.unit.tools.simulate.workloads import host, plan, recorded, simulation

WORKLOAD = """
hosts: [{name: 'h{i}', foreach: {i: 'range(0, 2)'}, memory: 1GB, cpu: 2}]
processes:
  - {name: 'p{i}', foreach: {i: 'range(0, 6)'}, memory: 200MB, cpu: 1, duration: 5s}
  - {name: lonely, labels: {required: {gpu: 'yes'}}}
until: 1min
"""


@pytest.fixture
def workload(tmp_path):
    (tmp_path / "w.yaml").write_text(WORKLOAD, encoding="utf-8")
    return tmp_path / "w.yaml"


@pytest.fixture(scope="module")
def content() -> bytes:
    plans = [plan(f"p{n}", 100.0, at=float(n), duration=4.0, cpu=0.5) for n in range(6)]
    return recorded(simulation([host("a"), host("b")], plans, until=20.0))


@pytest.fixture
def record(tmp_path, content):
    (tmp_path / "r.rosrec").write_bytes(content)
    return tmp_path / "r.rosrec"


def test_a_workload_is_compared_with_its_variants(rosrm, workload):
    result = rosrm("simulate", workload, "--policy", "threshold", "--hosts", "4")
    assert result.code == 0
    rows = [line for line in result.out.splitlines() if "/7" in line]
    runs = ["as given", "scoring.policy threshold", "hosts 4"]
    assert [row.split("  ")[0] for row in rows] == runs
    assert "as given: 1 never placed: lonely: " in result.out
    assert "events in" in result.out


@pytest.mark.parametrize(("width", "tables_shown"), [(80, 2), (160, 1)])
def test_the_table_reads_on_a_narrow_terminal(rosrm, workload, monkeypatch, width, tables_shown):
    """The table is split into two, so that no number and no name is cut."""
    monkeypatch.setattr(tables, "console", lambda: Console(width=width))
    result = rosrm("simulate", workload, "--variant", "migration: {automatic: false}")
    lines = result.out.splitlines()
    assert sum(line.startswith("RUN ") for line in lines) == tables_shown
    shown = lines[: next(n for n, line in enumerate(lines) if "never placed" in line)]
    assert max(map(len, shown)) <= width
    text = "\n".join(shown)
    assert all(word in text for word in ("MAKESPAN", "LONGEST", "OVER LIMIT", "as given", "6/7"))


def test_the_json_has_every_number_and_place(rosrm, workload):
    result = rosrm("simulate", workload, "--variant", "{name: calm, migration: {automatic: false}}",
                   "--json")  # fmt: skip
    report = json.loads(result.out)
    assert (report["record"], report["agreement"]) == (None, None)
    first, calm = report["runs"]
    assert (first["run"], calm["run"]) == ("as given", "calm")
    assert first["processes"] == 7 == first["finished"] + first["waiting"]
    assert list(first["never_placed"]) == ["lonely"]
    assert set(first["placements"]) == {f"p{n}" for n in range(6)}


def test_variants_may_stand_in_a_file_of_their_own(rosrm, workload, tmp_path):
    (tmp_path / "v.yaml").write_text("variants: [{hosts: 1}, {hosts: 3}]\n", encoding="utf-8")
    result = rosrm("simulate", workload, "--variants", tmp_path / "v.yaml", "--json")
    assert [run["hosts"] for run in json.loads(result.out)["runs"]] == [2, 1, 3]


def test_the_runs_are_drawn(rosrm, workload, tmp_path):
    result = rosrm("simulate", workload, "--plot", tmp_path / "p.svg")
    assert result.code == 0
    drawn = (tmp_path / "p.svg").read_text(encoding="utf-8")
    assert drawn.startswith("<?xml")
    assert len(drawn) > 5000


def test_without_matplotlib_it_says_what_to_install(rosrm, workload, tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "find_spec", lambda _name: None)
    result = rosrm("simulate", workload, "--plot", tmp_path / "p.png")
    assert result.code == 1
    assert result.err == (
        "rosrm: --plot needs matplotlib, which is not installed: "
        "pip install 'rosrm-simulate[plot]'\n"
    )


def test_no_matplotlib_is_imported_where_nothing_is_drawn(rosrm, workload, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert rosrm("simulate", workload).code == 0


def test_a_record_is_replayed_simulated_and_compared(rosrm, record):
    result = rosrm("simulate", record, "--hosts", "3")
    assert result.code == 0
    assert "replayed: all 6 decisions are the same" in result.out
    rows = [line.split()[0] for line in result.out.splitlines()[4:7]]
    assert rows == ["recorded", "simulated", "hosts"]
    assert "  6 of 6 processes started on the same host\n" in result.out
    assert "  moves: 0 recorded, 0 simulated\n" in result.out


def test_the_json_of_a_record_says_what_was_replayed_and_how_it_agrees(rosrm, record):
    report = json.loads(rosrm("simulate", record, "--json").out)
    assert report["record"]["decisions"] == 6
    assert report["record"]["different"] == 0
    assert report["agreement"]["same_host"] == 1.0
    assert report["agreement"]["ranked"]["memory"] < 0.02


def test_until_ends_the_recorded_run_as_well(rosrm, record):
    """Both rows and their agreement cover the same time."""
    report = json.loads(rosrm("simulate", record, "--until", "2500ms", "--json").out)
    assert [list(run["placements"]) for run in report["runs"]] == [["p0", "p1", "p2"]] * 2
    assert [run["finished"] for run in report["runs"]] == [0, 0]
    assert [run["span"] for run in report["runs"]] == pytest.approx([2.5, 2.5], abs=0.05)
    assert report["agreement"]["processes"] == 3
    assert report["record"]["decisions"] == 6


def test_a_replay_with_other_decisions_is_reported(rosrm, tmp_path, content):
    """The header names another policy than the one that decided."""
    from io import BytesIO

    from rosrm.recording.frames import FrameKind, frame, frames, opening

    def other(kind, body):
        if kind is not FrameKind.HEADER:
            return body
        header = json.loads(body)
        header["config"]["scoring"][0]["options"] = {"weights": {}}
        return json.dumps(header).encode()

    parts = [frame(kind, other(kind, body)) for kind, body, _ in frames(BytesIO(content), "r")]
    (tmp_path / "other.rosrec").write_bytes(opening() + b"".join(parts))
    result = rosrm("simulate", tmp_path / "other.rosrec")
    assert result.code == 0
    assert "led to other decisions; was the record" in result.out
    assert "recorded assign p" in result.out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda whole: whole[:-5], "the recording is cut short at byte"),
        (lambda whole: whole.replace(b"record 1", b"record 9", 1), "is a recording of version 9"),
        (lambda whole: whole[:500] + b"\0" + whole[501:], "the recording is damaged at byte"),
    ],
)
def test_a_bad_record_is_one_clear_error(rosrm, tmp_path, content, change, said):
    (tmp_path / "r.rosrec").write_bytes(change(content))
    result = rosrm("simulate", tmp_path / "r.rosrec")
    assert (result.code, result.err.count("\n"), result.out) == (2, 1, "")
    assert f"r.rosrec: {said}" in result.err


def test_a_record_cut_short_is_used_up_to_the_cut(rosrm, tmp_path, content):
    (tmp_path / "r.rosrec").write_bytes(content[:-200])
    result = rosrm("simulate", tmp_path / "r.rosrec", "--cut")
    assert (result.code, "cut short" in result.out) == (0, True)


@pytest.mark.parametrize("what", ["workload", "record"])
def test_the_invariants_of_the_core_are_checked_on_request(rosrm, request, what, monkeypatch):
    path = request.getfixturevalue(what)
    assert rosrm("simulate", path, "--check").code == 0
    monkeypatch.setattr(invariants, "INVARIANTS", (lambda _: iter(["p is nowhere"]),))
    assert rosrm("simulate", path).code == 0
    assert "p is nowhere" in rosrm("simulate", path, "--check").err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("w.yaml --policy wieghted",
         "--policy wieghted: unknown scoring policy 'wieghted'; did you mean"),
        ("w.yaml --hosts 0", "--hosts 0: hosts: 0 is not within 1..10000"),
        ("w.yaml --hosts -2", "--hosts -2: hosts: -2 is not within 1..10000"),
        ("w.yaml --until -5s", "--until: '-5s' is not greater than 0"),
        ("w.yaml --variant [1", "--variant:1:3: unreadable YAML"),
        ("w.yaml --plot p.gif", "has to end with .png, .svg, .pdf"),
        ("w.yaml --plot no/p.png", "there is no directory"),
        ("w.yaml --cut", "--cut is for records"),
        ("r.rosrec --seed 3", "--seed is for workloads"),
        ("map.npz", "map.npz: is neither the record of a master's run nor a workload in YAML"),
        ("none.yaml", "none.yaml: cannot be read: No such file or directory"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_before_the_run(
    rosrm, workload, record, tmp_path, monkeypatch, words, said
):
    (tmp_path / "map.npz").write_bytes(b"PK\3\4\0\0")
    monkeypatch.chdir(tmp_path)
    result = rosrm("simulate", *words.split())
    assert (result.code, result.out) == (2, "")
    assert said in result.err


def test_how_closely_a_run_was_simulated_can_be_asked_for(record, workload):
    assert carry_out(SimulationRequest(record)).agreement.same_host == 1.0
    assert carry_out(SimulationRequest(workload)).agreement is None
