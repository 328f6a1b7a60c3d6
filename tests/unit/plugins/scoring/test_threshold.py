"""The policy `threshold`: Eq. 1 with a steep cost near a limit and a veto at it."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.testing import host_view, one_row, process_view
from rosrm_scoring.threshold import Threshold, ThresholdOptions
from rosrm_scoring.weighted import Weighted, WeightedOptions

usages = st.one_of(st.floats(0, 2), st.just(float("nan")))
needs = st.dictionaries(st.sampled_from(["memory", "cpu", "gpu"]), st.floats(0, 1))


@st.composite
def hosts(draw):
    count = draw(st.integers(1, 30))
    columns = st.lists(usages, min_size=count, max_size=count)
    names = ("memory", "cpu", "gpu")
    return host_view({name: draw(columns) for name in names}, limit=draw(st.floats(0.0, 1.0)))


def score(view, needs=None, **options):
    return Threshold(ThresholdOptions(**options)).score(view, process_view(view, needs or {}))


def test_below_the_band_it_is_equation_1():
    """Far from every limit both policies agree."""
    view = host_view({"memory": [0.3, 0.6], "cpu": [0.5, 0.1]}, limit=0.9)
    expected = Weighted(WeightedOptions()).score(view, process_view(view))
    scores = score(view)
    assert np.array_equal(scores.value, expected.value)
    assert not scores.veto.any()
    assert scores.reason(0) == expected.reason(0)


def test_veto_above_enter_counts_the_need():
    """The host is judged with the process on it, against its own limit."""
    view = host_view({"memory": [0.70, 0.70]}, limit=0.8)  # 0.95 of the limit is 0.76
    assert not score(view, {"memory": 0.05}).veto.any()
    scores = score(view, {"memory": 0.07})
    assert scores.veto.all()
    assert scores.veto_reason(0) == "memory would be at 96.2% of its limit, over 95%"


def test_in_the_band_it_costs_steeply():
    """A host near its own limit costs more than a fuller one with a higher limit."""
    view = host_view({"memory": [0.85, 0.79], "cpu": [0.0, 0.79]})
    value = score(view).value
    assert value[0] > value[1] + 1


def test_the_fuller_the_costlier_within_the_band():
    """The least full host comes first if all are in the band."""
    value = score(host_view({"memory": [0.94, 0.82, 0.90]})).value
    assert list(np.argsort(value)) == [1, 2, 0]


def test_dip_below_enter_is_not_enough_to_return():
    """Hysteresis: a host just under the veto takes nothing while another is below the band."""
    for reading in (0.96, 0.94, 0.90, 0.85, 0.81):
        scores = score(host_view({"memory": [reading, 0.7], "cpu": [0.0, 0.75]}))
        assert int(np.argmin(np.where(scores.veto, np.inf, scores.value))) == 1
    scores = score(host_view({"memory": [0.69, 0.7], "cpu": [0.0, 0.75]}))
    assert int(np.argmin(scores.value)) == 0


def test_jitter_below_the_need_lets_no_second_process_in():
    """A host filled up to the threshold stays closed until it has lost a whole need."""
    full = 0.94
    for jitter in (-0.02, -0.01, 0.0, 0.01):
        assert score(host_view({"memory": [full + jitter]}), {"memory": 0.04}).veto[0]
    assert not score(host_view({"memory": [full - 0.04]}), {"memory": 0.04}).veto[0]


def test_busy_gpu_vetoes_only_who_needs_it():
    """A resource beyond the watched ones counts for a process that declares to need it."""
    view = host_view({"memory": [0.1], "gpu": [0.99]})
    assert not score(view, {"memory": 0.1}).veto[0]
    assert score(view, {"memory": 0.1, "gpu": 0.001}).veto[0]
    assert score(view, watch=("gpu",)).veto[0]


def test_reason_names_the_cost():
    """The reason names the resource that causes the cost near a limit."""
    reason = score(host_view({"memory": [0.9], "cpu": [0.1]})).reason(0)
    assert reason.startswith("1 x memory 90.0% + 0.5 x cpu 10.0% + ")
    assert reason.endswith(", as memory would be at 90.0% of its limit")


@settings(deadline=None)
@given(hosts(), needs)
def test_reasons_are_those_of_their_row(view, needed):
    """A host's reasons are the same alone and among others, and every score is finite."""
    policy = Threshold(ThresholdOptions())
    process = process_view(view, needed)
    together = policy.score(view, process)
    assert np.isfinite(together.value).all()
    for row in range(len(view.names)):
        alone = policy.score(*one_row(view, process, row))
        assert alone.reason(0) == together.reason(row)
        assert alone.veto_reason(0) == together.veto_reason(row)


fills = st.tuples(st.floats(0, 1), st.floats(0, 1))


@settings(deadline=None)
@given(st.lists(fills, min_size=1), st.lists(fills, min_size=1), st.floats(0.01, 1))
def test_hosts_below_the_band_go_before_hosts_within(empty, full, limit):
    """No usage and no weight puts a host in the band before one below it."""
    below = [(0.79 * memory, 0.79 * cpu) for memory, cpu in empty]
    within = [(0.81 + 0.13 * memory, 0.94 * cpu) for memory, cpu in full]
    memory, cpu = zip(*(below + within), strict=True)
    usage = {"memory": [m * limit for m in memory], "cpu": [c * limit for c in cpu]}
    scores = score(host_view(usage, limit=limit))
    assert not scores.veto.any()
    assert scores.value[: len(below)].max() < scores.value[len(below) :].min()


@settings(deadline=None)
@given(hosts())
def test_vetoes_exactly_what_is_above_enter(view):
    """No host at or below the threshold is vetoed, and every host above it is."""
    fill = np.nan_to_num(view.usage[:, :2], nan=0.0) / np.maximum(view.limit[:, :2], 1e-9)
    assert np.array_equal(score(view).veto, fill.max(axis=1) > 0.95)
