from rosrm.testing import ScoringContract, host_view, process_view
from rosrm_example import ExampleOptions, ExamplePolicy, register_scoring_policies


class TestExample(ScoringContract):
    offer = register_scoring_policies()[0]


def test_the_host_with_free_memory_is_preferred():
    hosts = host_view({"memory": [0.5, 0.2, 0.95]})
    scores = ExamplePolicy(ExampleOptions()).score(hosts, process_view(hosts))
    assert scores.value.argmin() == 1
    assert list(scores.veto) == [False, False, True]
