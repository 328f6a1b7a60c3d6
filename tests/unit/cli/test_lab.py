"""Options of `rosrm lab`, and invalid input."""

from __future__ import annotations

import pytest

from rosrm.errors import ConfigError
from rosrm_lab import GIB, MIB, HostPlan, HostStatus, needs
from rosrm_lab.cli import fraction, planned

LIMITS = {"memory": "1GiB", "cpu": "0.5", "disk": "2GiB"}


@pytest.fixture
def without_rights(monkeypatch):
    """Drop the rights of root."""
    monkeypatch.setattr(needs, "CAPABILITIES", {"CAP_SYS_TEST": (63, "for this test")})


def test_hosts_alike_hosts_that_differ_and_hosts_of_their_own():
    """A missing value is as for the other hosts; `none` lifts a limit."""
    assert planned(2, LIMITS, ["desk:memory=none,cpu=none", "host2:cpu=2", "shelf"]) == [
        HostPlan("host1", GIB, 0.5, 2 * GIB), HostPlan("host2", GIB, 2.0, 2 * GIB),
        HostPlan("desk", None, None, 2 * GIB), HostPlan("shelf", GIB, 0.5, 2 * GIB),
    ]  # fmt: skip


def test_numbers_are_base_units():
    """Plain numbers are bytes and cores, as in the files."""
    limits = {"memory": "67108864", "cpu": "0.5 cores", "disk": "33554432"}
    assert planned(1, limits, []) == [HostPlan("host1", 64 * MIB, 0.5, 32 * MIB)]


@pytest.mark.parametrize(
    ("changes", "more", "said"),
    [
        ({"memory": "1GX"}, [], "memory of host1: unknown unit 'GX'"),
        ({"cpu": "half"}, [], "cpu of host1: 'half' is not a number"),
        ({"disk": "none"}, [], "host host1: a disk has a size"),
        ({"memory": "-1GiB"}, [], "memory of host1"),
        ({}, ["desk:ram=1GiB"], "'ram' is no limit; allowed: memory=..., cpu=..., disk=..."),
        ({}, ["desk:memory"], "'memory' is no limit"),
        ({}, ["de sk"], "'de sk' cannot be the name of a host"),
        ({}, [":cpu=1"], "'' cannot be the name of a host"),
    ],
)
def test_a_wrong_argument_is_reported_with_its_place(changes, more, said):
    """The error also has the allowed values."""
    with pytest.raises(ConfigError) as raised:
        planned(1, {**LIMITS, **changes}, more)
    assert said in str(raised.value)


@pytest.mark.parametrize("number", [-1, 0, 251])
def test_a_wrong_number_is_refused(number):
    """Zero hosts are allowed only with --host."""
    with pytest.raises(ConfigError, match="allowed are 1 to 250"):
        planned(number, LIMITS, [])
    assert planned(0, LIMITS, ["desk"])


@pytest.mark.parametrize(("text", "value"), [("1%", 0.01), ("0.01", 0.01), ("100%", 1.0), ("0", 0)])
def test_a_share_is_percent_or_a_fraction(text, value):
    """Users write shares in both forms."""
    assert fraction(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["1", "5", "x", "%", "101%", "1.5", "-1%", "nan"])
def test_what_is_no_share_is_refused(text):
    """A bare 1 may mean 1 % or the whole."""
    with pytest.raises(ConfigError):
        fraction(text)


@pytest.mark.parametrize(
    "words",
    ["up", "exec host1 true", "cut host1", "heal host1", "loss host1 1%", "delay host1 50ms",
     "kill host1", "boot host1", "status", "down"],
)  # fmt: skip
def test_without_root_the_right_is_named_and_slices_are_offered(rosrm, without_rights, words):
    """The output is one message without a traceback, and the exit code is 1."""
    result = rosrm("lab", *words.split())
    assert (result.code, result.out) == (1, "")
    assert result.err.startswith("rosrm: a lab needs rights that are missing: CAP_SYS_TEST")
    assert "scope: slice" in result.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("up --subnet 10.9.8.7/24", "give an IPv4 range"),
        ("up --subnet 127.0.0.0/24", "127.0.0.0/8 is loopback"),
        ("up --lab a:b", "cannot be the name of a lab"),
        ("up --memory lots", "memory of host1: 'lots'"),
        ("cut host1 --direction up", "'up'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_looked_at(rosrm, without_rights, words, said):
    """The exit code is 2: nothing was done."""
    result = rosrm("lab", *words.split())
    assert (result.code, said in result.err) == (2, True), result.err


# --- output -----------------------------------------------------------------------------------


class OneHost:
    """Lab made with `--memory 1GiB`, whose host was cut off before it was switched off."""

    def boot(self, host):
        assert host == "host1"

    def status(self):
        return [
            HostStatus("lab", "host1", "up", "10.213.0.1", GIB, 100 * MIB, 0.5, 2 * 10**9,
                       10**6, 3, "cut")
        ]  # fmt: skip


@pytest.fixture
def one_host(monkeypatch):
    monkeypatch.setattr("rosrm_lab.cli.opened", lambda name: OneHost())
    monkeypatch.setattr("rosrm_lab.cli._check_rights", lambda: None)


def test_status_shows_sizes_in_their_units_and_counts_all_processes(rosrm, one_host):
    """`rosrm hosts` counts the processes run by rosrm alone, under RUNS."""
    header, *rows = rosrm("lab", "status", "--lab", "lab").out.splitlines()
    assert "100 MiB/1.0 GiB" in "\n".join(rows)
    assert "1.0 MB/2.0 GB" in "\n".join(rows)
    assert ("PROCESSES" in header, "RUNS" in header) == (True, False)


def test_boot_says_that_the_network_is_still_cut(rosrm, one_host):
    assert rosrm("lab", "boot", "host1").out == "host1 is up; its network is still: cut\n"
