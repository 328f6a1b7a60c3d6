"""Values that a work file may give to a node: what is accepted reaches the node."""

from __future__ import annotations

from array import array

import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from rclpy.parameter import Parameter

from rosrm.model.parameters import parameter_fault
from rosrm.slave.launch.ros_arguments import parameters_text

TEXTS = st.text(max_size=5) | st.sampled_from(["\0", "\ud800", "1", "true", "\x85", "\ufeff"])
SCALARS = st.none() | st.booleans() | st.integers(-(2**65), 2**65) | st.floats() | TEXTS
VALUES = SCALARS | st.lists(SCALARS, max_size=3) | st.just([[1]])


@given(name=TEXTS, value=VALUES)
@example(name="a", value=[])
@example(name="a", value="x\0y")
@example(name="", value=1)
@example(name="a", value=1e-05)
@example(name="a", value=[0])
def test_every_value_that_is_accepted_reaches_a_node(name, value):
    """The file of a process and the request for a component both have them."""
    if parameter_fault(name, value):
        return
    read = yaml.safe_load(parameters_text({"/**": {name: value}}))
    assert read == {"/**": {"ros__parameters": {name: value}}}
    message = Parameter(name, value=value).to_parameter_msg()
    reached = Parameter.from_parameter_msg(message).value
    assert (list(reached) if isinstance(reached, array) else reached) == value
