"""The policy `weighted`: Eq. 1 of the paper."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.testing import host_view, process_view
from rosrm_scoring.threshold import Threshold, ThresholdOptions
from rosrm_scoring.weighted import Weighted, WeightedOptions

usages = st.one_of(st.floats(0, 2), st.just(float("nan")))


@st.composite
def hosts(draw):
    count = draw(st.integers(1, 30))
    names = draw(st.lists(st.sampled_from(["memory", "cpu", "disk", "gpu"]), unique=True))
    columns = st.lists(usages, min_size=count, max_size=count)
    return host_view({name: draw(columns) for name in names or ["memory"]})


weighable = st.sampled_from(["memory", "cpu", "disk", "gpu", "absent"])
weights = st.dictionaries(weighable, st.floats(0, 1))


def score(view, **given_weights):
    policy = Weighted(WeightedOptions(given_weights) if given_weights else WeightedOptions())
    return policy.score(view, process_view(view))


def test_is_equation_1():
    """The score is w_mem x memory + w_cpu x cpu + w_disk x disk."""
    view = host_view({"memory": [0.5, 0.1], "cpu": [0.2, 0.4], "disk": [0.9, 0.3]})
    scores = score(view, memory=1.0, cpu=0.5, disk=0.1)
    assert scores.value == pytest.approx([0.5 + 0.1 + 0.09, 0.1 + 0.2 + 0.03])
    assert scores.veto is None


def test_default_weighs_memory_most():
    """By default memory has weight 1, CPU one half and disk zero."""
    view = host_view({"memory": [0.5, 0.4], "cpu": [0.1, 0.4], "disk": [0.0, 1.0]})
    assert score(view).value == pytest.approx([0.55, 0.6])


def test_named_weights_replace_all_defaults():
    """A resource that is not named has weight zero."""
    view = host_view({"memory": [0.5], "cpu": [0.2]})
    assert score(view, cpu=1.0).value == pytest.approx([0.2])


@pytest.mark.parametrize("policy", [Weighted, Threshold])
@pytest.mark.parametrize(
    ("missing", "value"), [({}, 1.5), ({"missing": "worst"}, 1.5), ({"missing": "ignore"}, 0.5)]
)
def test_a_host_that_does_not_measure_counts_as_full_unless_that_is_ignored(policy, missing, value):
    """A host without a probe is not preferred to those that have it, by default."""
    options = WeightedOptions if policy is Weighted else ThresholdOptions
    view = host_view({"memory": [0.5, 0.5], "gpu": [float("nan"), 0.2]})
    made = policy(options({"memory": 1.0, "gpu": 1.0}, **missing))
    assert made.score(view, process_view(view)).value == pytest.approx([value, 0.7])


def test_reason_is_the_sum_written_out():
    """The reason is the sum of the score's terms."""
    view = host_view({"memory": [0.5, 0.25], "cpu": [0.1, float("nan")]})
    assert score(view).reason(0) == "1 x memory 50.0% + 0.5 x cpu 10.0%"
    assert score(view).reason(1) == "1 x memory 25.0% + 0.5 x cpu 100.0% (not measured there)"
    assert "no resource" in score(view, network=1.0).reason(0)


@settings(deadline=None)
@given(hosts(), weights, st.floats(0, 1))
def test_more_usage_never_scores_lower(view, given_weights, more):
    """A fuller host is never preferred for being fuller."""
    fuller = host_view(
        {name: list(view.usage[:, column] + more) for column, name in enumerate(view.resources)}
    )
    policy = Weighted(WeightedOptions(given_weights))
    before = policy.score(view, process_view(view)).value
    assert (policy.score(fuller, process_view(fuller)).value >= before).all()
