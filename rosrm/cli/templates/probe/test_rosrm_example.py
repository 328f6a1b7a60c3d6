from rosrm.testing import ProbeContract, probe_context
from rosrm_example import ExampleOptions, ExampleProbe, register_probes


class TestExample(ProbeContract):
    offer = register_probes()[0]


def test_the_reading_is_a_fraction_of_the_option():
    probe = ExampleProbe(ExampleOptions(most=10_000_000), probe_context())
    (reading,) = probe.read()
    assert probe.resources[0].capacity == 10_000_000
    assert 0.0 < reading.usage < 1.0
