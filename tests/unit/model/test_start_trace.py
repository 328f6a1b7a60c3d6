"""Stamps in the environment of a traced start."""

from __future__ import annotations

from rosrm.model.start_trace import VARIABLE, stamped_in
from rosrm.model.traced_values import stamped_assignment, stamped_spec
from rosrm.model.values import Assignment, InstanceId, ProcessSpec


def test_a_start_without_a_trace_stays_the_same_object() -> None:
    """An untraced start is neither copied nor changed."""
    spec = ProcessSpec("p", command=("true",), environment={"A": "b"})
    assignment = Assignment(InstanceId("p", 1), spec, 1, "p")
    assert stamped_in(spec.environment, decided=1) is spec.environment
    assert stamped_spec(spec, decided=1) is spec
    assert stamped_assignment(assignment, decided=1) is assignment


def test_stamps_are_added_in_their_order() -> None:
    """Each part adds its stamps behind the earlier ones, and changes no other variable."""
    spec = ProcessSpec("p", command=("true",), environment={"A": "b", VARIABLE: "client_sent=1"})
    received = stamped_spec(spec, master_received=2)
    sent = stamped_assignment(
        Assignment(InstanceId("p", 1), received, 1, "p"), decided=3, journalled=4
    )
    trace = "client_sent=1 master_received=2 decided=3 journalled=4"
    assert sent.spec.environment == {"A": "b", VARIABLE: trace}


def test_a_variable_that_is_to_be_removed_gets_no_stamp() -> None:
    """The changes of an environment name a removed variable with None."""
    changes = {VARIABLE: None}
    assert stamped_in(changes, launch_sent=1) is changes
