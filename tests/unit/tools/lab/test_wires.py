"""Network faults: descriptions and firewall rules."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.errors import ConfigError
from rosrm_lab.wires import Link, check_delay, check_loss, check_rate, from_plain, ruleset, to_plain


def rules(**links):
    return [line.strip() for line in ruleset(links).splitlines() if "port" in line]


CHANCE = "numgen random mod 1000000 <"


@pytest.mark.parametrize(
    ("link", "expected"),
    [
        (Link(), []),
        (Link().changed("in", cut=True), ['oifname "port1" drop']),
        (Link().changed("out", cut=True), ['iifname "port1" drop']),
        (Link().changed("both", loss=0.01),
         [f'oifname "port1" {CHANCE} 10000 drop', f'iifname "port1" {CHANCE} 10000 drop']),
        # nft knows no number as large as its own modulus
        (Link().changed("in", rate=5e6), [
            'oifname "port1" limit rate over 5000000 bytes/second burst 500000 bytes drop']),
        (Link().changed("in", loss=1.0), ['oifname "port1" drop']),
        # a cut covers all that a loss would drop
        (Link().changed("both", loss=0.5).changed("out", cut=True),
         [f'oifname "port1" {CHANCE} 500000 drop', 'iifname "port1" drop']),
    ],
    ids=["whole", "in", "out", "loss", "rate", "loss of everything", "loss and cut"],
)  # fmt: skip
def test_each_faulty_direction_has_one_rule_at_the_switch(link, expected):
    """Frames to a host leave the switch through its port; a whole port has no rule."""
    assert rules(port1=link, port2=Link()) == expected


def test_all_other_frames_pass():
    assert "policy accept" in ruleset({})


def test_addresses_can_be_asked_for_during_a_cut():
    """Otherwise a cut in one direction would soon be one in both."""
    text = ruleset({"port1": Link().changed("in", cut=True)})
    assert text.index("ether type arp accept") < text.index("drop")


def test_the_old_rules_go_as_the_new_ones_come():
    """The ruleset replaces itself, also where there was none."""
    lines = ruleset({}).splitlines()
    assert lines[:2] == ["table bridge rosrm_lab", "delete table bridge rosrm_lab"]


@pytest.mark.parametrize(
    ("link", "words"),
    [
        (Link(), ""),
        (Link().changed("both", cut=True), "cut"),
        (Link().changed("in", cut=True), "in: cut"),
        (Link().changed("both", loss=0.015, delay=0.05), "loss 1.5 %, delay 50 ms"),
        (Link().changed("both", rate=5e6), "rate 5.0 MB/s"),
        (Link().changed("in", cut=True).changed("out", loss=0.1), "in: cut; out: loss 10 %"),
    ],
)
def test_a_link_in_words(link, words):
    """Directions are named where they differ."""
    assert link.describe() == words


def test_a_healed_link_is_a_new_one():
    """No fault is left."""
    bad = Link().changed("in", cut=True, loss=0.2).changed("out", delay=1.0)
    assert bad.changed("both", cut=False, loss=0.0, delay=0.0, rate=0.0) == Link()


def test_what_is_no_direction_is_refused():
    """An unknown word changes nothing."""
    with pytest.raises(ConfigError, match="'sideways'; allowed: in, out, both"):
        Link().changed("sideways", cut=True)


@pytest.mark.parametrize("share", [-0.01, 1.01, float("nan"), float("inf")])
def test_a_loss_that_is_no_fraction_is_refused(share):
    """NaN is refused, too."""
    with pytest.raises(ConfigError, match=r"not within 0..1"):
        check_loss(share)


@pytest.mark.parametrize("seconds", [-1.0, 61.0, float("nan")])
def test_a_delay_that_cannot_be_is_refused(seconds):
    """The bounds are the kernel's, and positive."""
    with pytest.raises(ConfigError, match=r"not within 0..60 s"):
        check_delay(seconds)


@pytest.mark.parametrize("rate", [-1.0, 999.0, 1e12, float("nan"), float("inf")])
def test_a_rate_that_cannot_be_is_refused(rate):
    """0 means no limit."""
    check_rate(0.0)
    with pytest.raises(ConfigError, match=r"allowed: 1 kB/s to 100 GB/s, and 0 for no limit"):
        check_rate(rate)


wires = st.tuples(st.booleans(), st.floats(0, 1), st.floats(0, 60), st.floats(0, 1e9))


@given(wires, wires)
def test_links_survive_their_file(into, out):
    """Every field is restored."""
    names = ("cut", "loss", "delay", "rate")
    link = Link().changed("in", **dict(zip(names, into, strict=True)))
    links = {"a": link.changed("out", **dict(zip(names, out, strict=True))), "b": Link()}
    assert from_plain(to_plain(links)) == links
