"""Plan of a lab: names, addresses, sizes."""

from __future__ import annotations

from ipaddress import IPv4Network

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.errors import ConfigError
from rosrm_lab import Lab
from rosrm_lab.plan import (
    GIB,
    MIB,
    HostPlan,
    LabPlan,
    check_free,
    check_usable,
    free_subnet,
    namespaces_of,
    parse_subnet,
    uniform,
)

NET = IPv4Network("10.9.8.0/24")


def plan(number=3, subnet=NET, name="lab"):
    return LabPlan(name, tuple(uniform(number)), subnet)


def test_hosts_get_addresses_in_their_order():
    """The first host has the first address, and so on."""
    lab = plan()
    assert [str(lab.address(name)) for name in lab.names] == ["10.9.8.1", "10.9.8.2", "10.9.8.3"]


@given(st.integers(1, 250), st.integers(0, 2**32 - 1), st.integers(8, 24))
def test_no_two_hosts_share_an_address_or_a_cable(number, base, prefix):
    """Addresses, hardware addresses and ports differ, and lie within the subnet.

    Hardware addresses are locally administered and unicast.
    """
    lab = plan(number, IPv4Network((base >> (32 - prefix) << (32 - prefix), prefix)))
    addresses = {lab.address(name) for name in lab.names}
    assert len(addresses) == number
    assert all(address in lab.subnet for address in addresses)
    assert lab.subnet.network_address not in addresses
    assert lab.subnet.broadcast_address not in addresses
    assert len({lab.mac(name) for name in lab.names}) == number
    assert len({lab.port(name) for name in lab.names}) == number
    assert all(len(lab.port(name)) <= 15 for name in lab.names)  # limit of Linux
    assert {int(lab.mac(name)[:2], 16) & 0b11 for name in lab.names} == {0b10}


def test_a_subnet_that_is_too_small_is_refused():
    """The network's own address and the broadcast address cannot be used."""
    assert plan(2, IPv4Network("10.9.8.0/30"))
    with pytest.raises(ConfigError, match=r"10.9.8.0/30 has 2 addresses for 3 hosts"):
        plan(3, IPv4Network("10.9.8.0/30"))
    with pytest.raises(ConfigError, match="has 0 addresses"):
        plan(1, IPv4Network("10.9.8.0/32"))


def test_the_same_host_twice_is_refused():
    """A name stands for one host."""
    with pytest.raises(ConfigError, match="host1 is given twice"):
        LabPlan("lab", (*uniform(2), HostPlan("host1")), NET)


@pytest.mark.parametrize("number", [0, 251, -1])
def test_a_wrong_number_of_hosts_is_refused(number):
    """The number is one at least, and no more than a /24 holds."""
    with pytest.raises(ConfigError, match=f"{number} hosts; allowed are 1 to 250"):
        uniform(number)


@pytest.mark.parametrize("name", ["", "-a", "a-", "a b", "a:b", "a/b", "..", "a" * 33, "ä", "a_b"])
def test_a_name_that_no_host_can_have_is_refused(name):
    """Namespaces, folders and host names are made of it."""
    with pytest.raises(ConfigError, match="cannot be the name of a host"):
        HostPlan(name)
    with pytest.raises(ConfigError, match="cannot be the name of a lab"):
        plan(name=name)


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"memory": MIB}, "memory 1.04858e.06 is too little; at least 16MiB"),
        ({"cpu": 0.001}, "cpu 0.001 is too little; at least 0.01 cores"),
        ({"disk": 0}, "disk 0 is too little; at least 16MiB"),
        ({"memory": -1}, "memory -1 is too little"),
    ],
)
def test_a_limit_that_leaves_no_room_is_refused(limits, said):
    """No process could start on such a host."""
    with pytest.raises(ConfigError, match=said):
        HostPlan("host1", **limits)


def test_an_unknown_host_is_named_with_those_there_are():
    """The list helps to find the right name."""
    with pytest.raises(ConfigError, match="no host 'host9'; it has: host1, host2, host3"):
        plan().address("host9")


def test_a_plan_survives_its_file():
    """Every field is restored."""
    lab = LabPlan("x", (HostPlan("a", GIB, 0.5, 2 * GIB), HostPlan("b")), NET)
    assert LabPlan.from_plain(lab.to_plain()) == lab


def test_the_first_free_range_is_taken():
    """A range is not free when a larger or smaller one overlaps it; all may be taken."""
    taken = [IPv4Network("10.213.0.0/24"), IPv4Network("10.213.1.128/25")]
    assert free_subnet([]) == IPv4Network("10.213.0.0/24")
    assert free_subnet(taken) == IPv4Network("10.213.2.0/24")
    with pytest.raises(ConfigError, match="in use on this machine; choose one with --subnet"):
        free_subnet([IPv4Network("10.0.0.0/8")])


def test_a_range_in_use_is_refused_with_its_owner():
    """The owner helps to choose another range."""
    taken = [(IPv4Network("10.9.0.0/16"), "eth0")]
    check_free(IPv4Network("10.8.0.0/24"), taken)
    with pytest.raises(ConfigError, match=r"10.9.8.0/24 is in use: eth0 has 10.9.0.0/16"):
        check_free(NET, taken)


@pytest.mark.parametrize(
    ("subnet", "what"),
    [
        ("127.0.0.0/24", r"127\.0\.0\.0/8 is loopback"),
        ("224.0.0.0/24", r"224\.0\.0\.0/4 is multicast"),
        ("255.255.255.0/24", r"240\.0\.0\.0/4 is reserved"),
        ("0.0.0.0/24", r"0\.0\.0\.0/8 is this network"),
        ("96.0.0.0/3", "loopback"),
    ],
)
def test_a_range_with_addresses_that_no_host_can_have_is_refused(subnet, what):
    """A larger range around it is refused, too, before anything is made, with an alternative."""
    with pytest.raises(ConfigError, match=f"{subnet} cannot be a lab's: .*{what}.*10.9.0.0/24"):
        check_usable(IPv4Network(subnet))
    with pytest.raises(ConfigError, match="cannot be a lab's"):
        Lab("lab", uniform(1), subnet=IPv4Network(subnet))


def test_the_ranges_of_hosts_are_usable():
    """Private and public ranges are usable."""
    for text in ("10.9.0.0/24", "192.168.0.0/16", "126.0.0.0/8", "128.0.0.0/8", "223.255.255.0/24"):
        check_usable(IPv4Network(text))


@pytest.mark.parametrize("text", ["10.9.8.7/24", "fe80::/64", "hallo", "10.9.8.0/33", ""])
def test_what_is_no_range_is_refused(text):
    """Host bits, IPv6 and invalid text are refused."""
    with pytest.raises(ConfigError, match="give an IPv4 range such as"):
        parse_subnet(text)


def test_the_namespaces_of_a_lab_are_its_own():
    """No lab's name is the beginning of another's namespaces."""
    there = ["rosrm-lab:a", "rosrm-lab:a:b", "rosrm-lab:a-b", "rosrm-lab:a-b:c", "other", "a"]
    assert list(namespaces_of("a", there)) == ["rosrm-lab:a:b", "rosrm-lab:a"]
    assert list(namespaces_of("b", there)) == []


def test_every_host_knows_the_others_by_name():
    """Their /etc/hosts has all of them, and localhost."""
    lines = plan().hosts_file().splitlines()
    assert "127.0.0.1 localhost" in lines
    assert "10.9.8.3 host3" in lines
