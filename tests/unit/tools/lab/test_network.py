"""Errors of a lab's network: refusals of the kernel or of a container."""

from __future__ import annotations

from ipaddress import IPv4Network

import pytest

from rosrm.errors import LabError
from rosrm_lab import network
from rosrm_lab.plan import LabPlan, uniform
from rosrm_lab.wires import Link

PLAN = LabPlan("lab", tuple(uniform(2)), IPv4Network("10.9.8.0/24"))


class Kernel:
    """Fake netlink connection to a kernel that has neither bridges nor cables."""

    def __init__(self, **_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def link(self, *_, **__):
        raise network.NetlinkError(95)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda: network.make_switch(PLAN), "the bridge between the hosts cannot be made"),
        (lambda: network.plug_in(PLAN, "host1", Link()), "a host cannot be connected"),
    ],
)
def test_a_kernel_without_bridges_is_told_how_to_get_them(monkeypatch, change, said):
    """The error has the kernel's own message and the remedy."""
    monkeypatch.setattr(network.netns, "create", lambda name: None)
    monkeypatch.setattr(network, "IPRoute", Kernel)
    with pytest.raises(
        LabError, match=rf"{said}.*: Operation not supported \(ENOTSUP\)\. .*modprobe -a bridge"
    ):
        change()


@pytest.mark.parametrize(
    ("refusal", "said"),
    [
        (PermissionError(1, "mount rundir failed"), r"mount rundir failed \(EPERM\)"),
        (RuntimeError("child process is dead, status: -31"), "child process is dead"),
    ],
)
def test_a_container_that_forbids_namespaces_is_told_of_privileges(monkeypatch, refusal, said):
    """The container's rules may refuse a system call or kill the caller."""

    def refuse(name):
        raise refusal

    monkeypatch.setattr(network.netns, "create", refuse)
    with pytest.raises(LabError, match=f"{said}.*docker run --privileged"):
        network.make_switch(PLAN)
