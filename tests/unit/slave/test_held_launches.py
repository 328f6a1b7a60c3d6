"""Jobs that the slave hands to its supervisor before a slot is free."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rosrm.core.slave.commands import Launch, Stop
from rosrm.core.slave.events import StopOrdered, SupervisorReplaced, TimePassed
from rosrm.core.slave.handlers import REPORT_WAIT
from rosrm.model.adoption import Adoption
from rosrm.model.values import InstanceId, InstanceState, InstanceStatus, Kind, Readiness
from tests.unit.slave.rig import PLAIN, Slave, launched, states

JOB = replace(PLAIN, kind=Kind.JOB)
HELD, RUNNING, EXITED = InstanceState.HELD, InstanceState.RUNNING, InstanceState.EXITED


def slave(holds_starts=True, slots=1):
    """Return a slave with slots, in one of which a job runs."""
    one = Slave(max_processes=slots)
    one.step(SupervisorReplaced((), holds_starts=holds_starts))
    one.assign(JOB)
    one.status(RUNNING)
    return one


def test_the_next_job_is_handed_over_and_reported_as_held():
    """The supervisor gets the bound on running instances; the master learns of a longer wait."""
    one = slave()
    (launch,) = one.assign(JOB, 2)
    assert isinstance(launch, Launch)
    assert ([one.instance.number for one in launch.assignments], launch.slots) == ([2], 1)
    assert states(one.step(TimePassed(), after=REPORT_WAIT)) == [HELD]


def test_one_job_is_handed_over_at_a_time():
    """The next job follows once the held one runs, so the order of the queue is kept."""
    one = slave()
    one.assign(JOB, 2)
    assert launched(one.assign(JOB, 3)) == []
    assert launched(one.status(EXITED)) == []
    assert launched(one.status(RUNNING, number=2)) == [InstanceId("p", 3)]


def test_a_held_job_is_launched_once():
    """A report that the job is held changes nothing; nor does a repeated assignment."""
    one = slave()
    one.assign(JOB, 2)
    assert one.status(HELD, number=2) == []
    assert launched(one.assign(JOB, 2)) == []


def test_a_stop_of_a_held_job_goes_to_the_supervisor():
    """Only the supervisor knows whether the job has started since."""
    one = slave()
    one.assign(JOB, 2)
    assert one.step(StopOrdered(InstanceId("p", 2))) == [Stop(InstanceId("p", 2))]


@pytest.mark.parametrize(
    ("spec", "more"),
    [
        (PLAIN, {}),
        (replace(JOB, ros=True, module="m", command=(), readiness=Readiness("graph")), {}),
        (replace(JOB, adoption=Adoption(7, 1, "boot")), {}),
        (JOB, {"snapshots_from": 1}),
        (JOB, {"restored": True}),
    ],
    ids=["service", "node", "adopted", "snapshot", "restored"],
)
def test_a_start_that_needs_the_slave_is_not_handed_over(spec, more):
    """The slave fetches files, awaits nodes and adopts processes at the start itself."""
    one = slave()
    assert launched(one.assign(spec, 2, **more)) == []
    assert launched(one.status(EXITED)) == [InstanceId("p", 2)]


def test_nothing_is_handed_to_a_supervisor_that_would_start_it_at_once():
    """A supervisor of an earlier version ignores the bound."""
    one = slave(holds_starts=False)
    assert launched(one.assign(JOB, 2)) == []
    assert launched(one.status(EXITED)) == [InstanceId("p", 2)]


def test_nothing_is_handed_over_while_another_one_starts():
    """The supervisor may not know the starting instance yet, and would count its slot as free."""
    one = slave(slots=2)
    one.assign(JOB, 2)
    assert launched(one.assign(JOB, 3)) == []
    assert launched(one.status(RUNNING, number=2)) == [InstanceId("p", 3)]


def test_a_held_job_of_a_former_run_of_the_slave_keeps_its_turn():
    """After its restart the slave starts nothing in the place of the held job."""
    one = Slave(max_processes=1)
    statuses = (
        InstanceStatus(InstanceId("p", 1), RUNNING, pid=5), InstanceStatus(InstanceId("p", 2), HELD)
    )  # fmt: skip
    assert states(one.step(SupervisorReplaced(statuses, holds_starts=True)))[-1] is HELD
    one.assign(JOB, 3)
    assert launched(one.status(EXITED)) == []
    assert launched(one.status(RUNNING, number=2)) == [InstanceId("p", 3)]
