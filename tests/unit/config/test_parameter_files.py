"""Files of ROS parameters, as ROS reads them."""

from __future__ import annotations

import pytest

from rosrm.config.parameter_files import parse_parameters
from rosrm.model.values import ParameterSource


def test_values_and_keys_are_those_of_ros():
    """A key is text, `1e3` a number, and the tag that launch writes for a tuple is ignored."""
    text = (
        "n:\n  ros__parameters:\n    on: yes\n    1: 1e3\n    gains: !!python/tuple [1.0, 2.0]\n"
        "    day: 2026-11-27\n    base: &b {x: 1}\n    more: {<<: *b, y: 2}\n"
    )
    expected = {
        "on": True, "1": 1000.0, "gains": [1.0, 2.0], "day": "2026-11-27", "base.x": 1,
        "more.x": 1, "more.y": 2,
    }  # fmt: skip
    assert parse_parameters(text) == (ParameterSource(nodes="/n", parameters=expected),)


def test_an_empty_file_has_no_sections():
    assert parse_parameters("# nothing\n") == ()


@pytest.mark.parametrize("text", ["a: [", "!!python/object/apply:os.getcwd []", "a: b: c"])
def test_another_text_is_refused(text):
    """No object of Python is made from a file."""
    with pytest.raises(ValueError, match=r".+"):
        parse_parameters(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\n".join(f"a{n + 1}: &a{n + 1} {{x: *a{n}, y: *a{n}}}" for n in range(60)), "more than"),
        ("a: &a {ros__parameters: *a}", "more than"),
        ("[" * 5000, "nested too deeply"),
    ],
    ids=["aliases of aliases", "an alias of itself", "depth"],
)
def test_a_small_file_that_becomes_large_is_refused_at_once(text, said):
    """Its host would otherwise write parameters without an end."""
    with pytest.raises(ValueError, match=said):
        parse_parameters(text if "*a0" not in text else f"a0: &a0 {{}}\n{text}")
