"""Files of the examples, which rosrm accepts; arguments and folder of the demo."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosrm.config.cluster import load_cluster
from rosrm.config.host import load_host
from rosrm.config.work import load_work
from rosrm.extensions.registry import Registry
from rosrm_examples import demo, demo_frame

EXAMPLES = Path(__file__).parents[3] / "examples"
WORK = sorted((EXAMPLES / "work").glob("*.yaml"))


@pytest.fixture(scope="module")
def registry():
    return Registry.discover()


def test_the_cluster_file(registry):
    config = load_cluster(EXAMPLES / "cluster.yaml", registry)
    assert config.ros.domain == 42
    assert config.ros.discovery_range == "localhost"
    assert config.migration.hysteresis == 1.0


def test_the_host_file_is_a_slice_in_the_same_domain(registry):
    config = load_host(EXAMPLES / "host.yaml", registry)
    assert config.scope == "slice"
    assert config.budget["memory"] == 768 * 2**20
    assert config.ros == load_cluster(EXAMPLES / "cluster.yaml", registry).ros


def test_there_is_work():
    assert {path.stem for path in WORK} >= {"hello", "holders", "map"}


@pytest.mark.parametrize("path", WORK, ids=lambda path: path.stem)
def test_work_that_rosrm_takes(path, registry):
    specs = load_work(path, registry)
    assert len({spec.name for spec in specs}) == len(specs) >= 2
    assert f"rosrm submit examples/work/{path.name}" in path.read_text()


def test_the_holders_are_of_the_papers_sizes(registry):
    specs = load_work(EXAMPLES / "work" / "holders.yaml", registry)
    holders = [spec for spec in specs if spec.name.startswith("holder")]
    sizes = [float(spec.arguments[1]) for spec in holders]
    assert (len(sizes), min(sizes), max(sizes)) == (30, 8, 80)
    assert [spec.needs["memory"] for spec in holders] == [size * 1e6 for size in sizes]


# --- command line of the demo -------------------------------------------------------------------


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the demo's main up to its start; return exit status and output."""
    monkeypatch.setattr(demo_frame, "StopSignals", lambda: None)

    def run_main(*arguments):
        status = demo.main([str(argument) for argument in arguments])
        return status, capsys.readouterr().err

    return run_main


@pytest.mark.parametrize(
    ("drive", "pieces", "expected"),
    [("nowhere", "2", "demo: drive 'nowhere'"), ("street:8", "5", "at most 4 pieces, not 5")],
)
def test_a_drive_that_cannot_be_cut_is_refused(run, tmp_path, drive, pieces, expected):
    status, said = run("--out", tmp_path, "--drive", drive, "--pieces", pieces)
    assert (status, expected in said) == (2, True), said


SMALL = ("--drive", "street:8", "--pieces", "2")


def test_a_folder_of_somebody_else_is_left_alone(run, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    status, said = run("--out", tmp_path, *SMALL)
    assert (status, "name a new or empty folder" in said) == (2, True)
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_a_folder_that_another_demo_writes_to(run, tmp_path):
    with demo_frame.own_folder(tmp_path, demo.LEFT):
        status, said = run("--out", tmp_path, *SMALL)
    assert (status, "another demo is writing to it" in said) == (2, True)


def test_an_earlier_demo_is_cleared_away_and_nothing_else(tmp_path):
    demo_frame.own_folder(tmp_path, demo.LEFT).close()
    (tmp_path / "cluster").mkdir()
    (tmp_path / "summary.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("keep")
    demo_frame.own_folder(tmp_path, demo.LEFT).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".rosrm-demo", "notes.txt"]


def test_too_little_memory_is_said(run, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "budget_for", lambda free: 2**20)
    status, said = run("--out", tmp_path, *SMALL)
    assert (status, "MiB of memory are free here" in said) == (2, True)


@pytest.mark.parametrize("pace", ["0.1", "9", "fast", "nan"])
def test_a_pace_that_is_none(run, tmp_path, pace):
    with pytest.raises(SystemExit):
        run("--out", tmp_path, "--pace", pace)
