"""Figures of the comparison with Ray and Dask."""

from __future__ import annotations

from benchmarks.peers.__main__ import figures_of


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
