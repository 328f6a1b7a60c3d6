"""Compatibility of two hosts for a dump and a restore, by the facts that they report."""

from __future__ import annotations

import pytest

from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.compatibility import FACTS, facts_of, features, mismatch
from tests.criu_kit import HOST_FACTS as HERE


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"kernel": "5.15.0"},
        {"version": "4.2.2"},
        {"version": "4.10"},
        {"cpu": "avx avx2 avx512f sse2"},
        {"uid": "0", "all_users": "yes"},
    ],
    ids=str,
)
def test_an_equal_host_or_one_with_more_takes_the_images(change):
    """The release of the kernel may differ in any way."""
    assert mismatch(HERE, {**HERE, **change}) == ""


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"machine": "aarch64", "cpu": "fp asimd"},
            "its machine is aarch64, the source's x86_64",
        ),
        (
            {"version": "4.2"},
            "its CRIU 4.2 is older than the source's 4.2.1, whose images it may not understand",
        ),
        (
            {"cpu": "sse2"},
            "its processor lacks what a program of the source may use already: avx and avx2",
        ),
        (
            {"uid": "1001"},
            (
                "the process belongs to the user 1000, and its CRIU restores only those of the "
                "user 1001"
            ),
        ),
        (
            {"python": "/opt/python"},
            "its Python interpreter is /opt/python, the source's /usr/bin/python3.12",
        ),
        ({"python_version": "3.12.4"}, "its Python is 3.12.4, the source's 3.12.3"),
        ({"libc": ""}, "its C library is none, the source's glibc 2.39"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_a_difference_is_named_with_both_values(change, expected):
    assert mismatch(HERE, {**HERE, **change}) == expected


def test_of_many_missing_features_the_first_are_named():
    there = {**HERE, "cpu": ""}
    source = {**HERE, "cpu": " ".join(f"f{n}" for n in range(9))}
    assert mismatch(source, there).endswith(": f0, f1, f2, f3, f4, f5, f6 and 2 more")


@pytest.mark.parametrize("name", FACTS)
def test_a_fact_that_one_host_lacks_makes_no_match(name):
    part = {key: value for key, value in HERE.items() if key != name}
    for one, other in ((part, HERE), (HERE, part)):
        assert mismatch(one, other) == f"it is not known of both hosts what they have: {name}"


def test_this_host_reports_every_fact_and_takes_its_own_images():
    facts = facts_of(CriuBinary(("criu",), "4.2.1"))
    assert facts.keys() == FACTS.keys()
    assert all(facts.values())
    assert mismatch(facts, facts) == ""


@pytest.mark.parametrize(
    ("cpuinfo", "expected"),
    [
        (
            "processor : 0\nflags\t\t: fpu avx2 hypervisor constant_tsc sse4_2 amx_tile ibrs\n",
            "amx_tile avx2 fpu sse4_2",
        ),
        ("Features\t: fp asimd aes\nCPU part\t: 0xd0b\n", "aes asimd fp"),
        ("Features : fp sve aes\n\nFeatures : fp aes\n", "aes fp"),
        ("", ""),
    ],
    ids=["x86", "arm", "different-cores", "empty"],
)
def test_the_features_that_programs_use_on_all_cores_count(cpuinfo, expected):
    """On x86 flags of the kernel are left out; on ARM all features count."""
    assert features(cpuinfo) == expected
