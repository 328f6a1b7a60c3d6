from rosrm.testing import FilterContract, host_view, process_view
from rosrm_example import ExampleFilter, ExampleOptions, register_filters


class TestExample(FilterContract):
    offer = register_filters()[0]
    options = {"most": 2}


def test_a_host_with_too_many_processes_fails_with_the_number():
    hosts = host_view({"memory": [0.1, 0.1]}, processes=[1, 2])
    process = process_view(hosts)
    limit = ExampleFilter(ExampleOptions(most=2))
    assert list(limit.mask(hosts, process)) == [True, False]
    assert limit.reason(hosts, process, 1) == "it runs 2 processes; at most 2 are allowed"
