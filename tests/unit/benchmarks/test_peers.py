"""Figures of the comparison with Ray, Dask and Slurm."""

from __future__ import annotations

from benchmarks.peers.__main__ import figures_of, why_no_slurm


def test_times_are_beyond_the_bare_spawn_of_the_same_round():
    """The second round was on a busier machine; its spawns were slower, too."""
    figures = figures_of({
        "stamps": {"bare": [[1.0, 1.0, 9.0], [4.0, 4.0, 4.0]], "rosrm": [[3.0], [6.0]]},
        "jobs": {"bare": [900.0, 700.0], "rosrm": [500.0, 400.0]},
    })  # fmt: skip

    assert figures["spawn_ms"] == 2.5
    assert figures["beyond_spawn_ms"] == {"rosrm": 2.0}
    assert figures["beyond_spawn_ms_all"] == {"rosrm": [2.0, 2.0]}
    assert figures["jobs_per_s"] == {"bare": 800.0, "rosrm": 450.0}


def test_slurm_is_left_out_with_the_reason(monkeypatch, tmp_path):
    """A program of Slurm is missing, or the user is not root."""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert why_no_slurm().startswith("munged, slurmctld, slurmd, ")
    for name in ("munged", "slurmctld", "slurmd", "salloc", "squeue", "sinfo", "srun"):
        (tmp_path / name).touch(0o755)
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert why_no_slurm() == "its daemons need root"
