"""ROS parameters from several sources: the sections of files, patterns of nodes, their order."""

from __future__ import annotations

import pytest

from rosrm.model.parameters import applies_to, merged_parameters, pattern_fault, sections_of
from rosrm.model.values import ParameterSource


def test_the_sections_of_a_file_are_sources_in_its_order():
    """Namespaces may be nested, a slash may be left out, and nested names get dots."""
    document = {
        "/**": {"ros__parameters": {"use_sim_time": True}},
        "robot": {
            "planner": {"ros__parameters": {"grid": {"size": 3}}},
            "ros__parameters": None,
        },
    }
    assert list(sections_of(document)) == [
        ParameterSource(nodes="/**", parameters={"use_sim_time": True}),
        ParameterSource(nodes="/robot"),
        ParameterSource(nodes="/robot/planner", parameters={"grid.size": 3}),
    ]


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ([1], "names of nodes"),
        ({"rate": 10}, "rate: `ros__parameters` is required below the name of a node"),
        ({"a": {"ros__parameters": [1]}}, "a.ros__parameters: a mapping is required"),
        ({"my node": {"ros__parameters": {}}}, "'/my node' is no name or pattern of nodes"),
    ],
)
def test_another_document_is_refused(document, said):
    """The message has the key at which the document is wrong."""
    with pytest.raises(ValueError, match=said):
        list(sections_of(document))


@pytest.mark.parametrize(
    ("nodes", "name", "applies"),
    [
        ("/**", "/a/b", True), ("/*", "/a", True), ("/*", "/a/b", False), ("/a/*", "/a/b", True),
        ("/**/b", "/b", True), ("/**/b", "/x/y/b", True), ("/a/**/c", "/a/c", True),
        ("/a", "/a", True), ("/a", "/ab", False), ("/a/**", "/ab", False),
    ],
)  # fmt: skip
def test_a_pattern_stands_for_parts_of_names(nodes, name, applies):
    """`*` is one part of a name, `**` any number of parts."""
    assert applies_to(nodes, name) is applies
    assert not pattern_fault(nodes)


def test_the_last_source_that_applies_counts():
    """The order decides, not how exact a pattern is; what does not apply is left out."""
    sources = [
        ParameterSource(nodes="/robot/planner", parameters={"a": 1, "b": 1}),
        ParameterSource(nodes="/other", parameters={"a": 2}),
        ParameterSource(nodes="/**", parameters={"b": 3}),
    ]
    assert merged_parameters(sources, "/robot/planner") == {"/**": {"a": 1, "b": 3}}


def test_without_a_name_each_pattern_remains():
    """A program may have several nodes. A repeated pattern applies at its last place."""
    sources = [
        ParameterSource(nodes="/a", parameters={"x": 1, "y": 1}),
        ParameterSource(nodes="/**", parameters={"x": 2}),
        ParameterSource(nodes="/a", parameters={"x": 3}),
        ParameterSource(nodes="/empty"),
    ]
    merged = merged_parameters(sources, "")
    assert list(merged.items()) == [("/**", {"x": 2}), ("/a", {"x": 3, "y": 1})]
