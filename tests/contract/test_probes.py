"""The probe contract, for every shipped probe in every scope, as for a third party's."""

from pathlib import Path
from typing import ClassVar

import pytest

from rosrm.extensions.contracts import ProbeOffer
from rosrm.model.values import Reading, ResourceDescription
from rosrm.slave.sessions import SessionTable
from rosrm.testing import FakeProbe, ProbeContract, probe_context
from rosrm_resources.plugin import register_probes

OFFERS = {offer.name: offer for offer in register_probes()}
CGROUP = probe_context("cgroup")
SLICE = probe_context(
    "slice",
    budget={"cpu": 1.0, "memory": 2.0**31, "disk": 1e9},
    data_directory=Path(__file__).parent,
    sessions=SessionTable(),
)


class TestCpu(ProbeContract):
    offer = OFFERS["cpu"]


class TestCpuOfCgroup(TestCpu):
    context = CGROUP


class TestCpuOfSlice(TestCpu):
    context = SLICE


class TestMemory(ProbeContract):
    offer = OFFERS["memory"]


class TestMemoryOfCgroup(TestMemory):
    context = CGROUP


class TestMemoryOfSlice(TestMemory):
    context = SLICE


class TestDisk(ProbeContract):
    offer = OFFERS["disk"]


class TestDiskOfSlice(TestDisk):
    context = SLICE


class TestGpu(ProbeContract):
    offer = OFFERS["gpu"]


class TestNetwork(ProbeContract):
    offer = OFFERS["network"]
    options: ClassVar = {"interfaces": ("lo",), "capacity": 1e9}


def test_each_shipped_probe_is_here():
    """Each probe in the plugin must have a contract class in this file."""
    held = {contract.offer.name for contract in ProbeContract.__subclasses__()}
    assert set(OFFERS) <= held


class TestFake(ProbeContract):
    """The probe contract of `rosrm.testing.FakeProbe`."""

    offer = ProbeOffer(
        "fake",
        lambda options, context: FakeProbe(a=0.5, b=0.1),
        summary="a fake",
        resources=("a", "b"),
    )


class _Leaking(FakeProbe):
    def __init__(self):
        super().__init__(a=0.5)
        self.file = Path(__file__).open()  # noqa: SIM115 - the leak is the point
        _LEAKED.append(self.file)


_LEAKED = []


def _described(*description):
    """Return a class of probes with this description of a resource."""
    return type("Described", (FakeProbe,), {"resources": (ResourceDescription(*description),)})


class _Chatty(FakeProbe):
    def read(self):
        return [Reading("a", 0.1), Reading("b", 0.1)]


@pytest.mark.parametrize(
    ("make", "test"),
    [
        (_described("", "1", 1.0), "test_resources_are_well_described"),
        (_described("a", "1", 0.0), "test_resources_are_well_described"),
        (_described("a", None, 1.0), "test_resources_are_well_described"),
        (lambda: FakeProbe(undeclared=0.1), "test_resources_are_well_described"),
        (lambda: FakeProbe(a=float("nan")), "test_reads_each_resource_once"),
        (lambda: _Chatty(a=0.1), "test_reads_each_resource_once"),
        (_Leaking, "test_close_releases_files"),
    ],
)
def test_contract_catches(make, test):
    """A probe that breaks the contract fails the test of that clause."""
    contract = ProbeContract()
    contract.offer = ProbeOffer(
        "bad", lambda options, context: make(), summary="bad", resources=("a",)
    )
    try:
        with pytest.raises(AssertionError):
            getattr(contract, test)()
    finally:
        while _LEAKED:
            _LEAKED.pop().close()


def test_a_probe_without_an_answer_is_named_in_another_thread():
    """A `read` that returns None in a thread is a wrong answer, not a late one."""
    contract = ProbeContract()

    class Silent(FakeProbe):
        def read(self):
            return None

    contract.offer = ProbeOffer("bad", lambda options, context: Silent(a=0.1), resources=("a",))
    with pytest.raises(AssertionError, match=r"answered None; a list of Readings .*\.py:\d+"):
        contract.test_reads_in_another_thread()
