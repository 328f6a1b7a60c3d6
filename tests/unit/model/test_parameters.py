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


OWN = "/robot/planner"


def test_every_section_remains_for_the_other_nodes_of_a_process():
    """A repeated section is at its first place with its last values, as in ROS."""
    sources = [
        ParameterSource(nodes="/a", parameters={"x": 1, "y": 1}),
        ParameterSource(nodes="/**", parameters={"x": 2}),
        ParameterSource(nodes="/a", parameters={"x": 3}),
        ParameterSource(nodes="/empty"),
    ]
    expected = [("/a", {"x": 3, "y": 1}), ("/**", {"x": 2})]
    assert list(merged_parameters(sources).items()) == expected
    assert list(merged_parameters(sources, OWN).items()) == expected


def test_the_section_of_its_own_node_is_the_last_and_has_all_that_applies():
    """An alias has that of the node's own name; rclpy knows no pattern but `/**`."""
    sources = [
        ParameterSource(nodes=OWN, parameters={"a": 1}),
        ParameterSource(nodes="/other", parameters={"a": 2}),
        ParameterSource(nodes="/robot/*", parameters={"b": 3}),
    ]
    others = [("/other", {"a": 2}), ("/robot/*", {"b": 3})]
    own = {"a": 1, "b": 3}
    assert list(merged_parameters(sources, OWN).items()) == [*others, (OWN, own)]
    aliased = merged_parameters(sources, OWN, "/robot/alias")
    assert list(aliased.items()) == [*others, ("/robot/alias", own)]


@pytest.mark.parametrize(("file", "value"), [("p.yaml", 1), ("", 2)])
def test_a_full_name_in_a_file_overrides_patterns_but_no_later_entry_of_the_user(file, value):
    """Files are read as by ROS; each entry of a list overrides those before it."""
    sources = [
        ParameterSource("p.yaml", OWN, {"a": 1}), ParameterSource(file, "/**", {"a": 2}),
    ]  # fmt: skip
    assert merged_parameters(sources, OWN).get(OWN, {"a": 2}) == {"a": value}


def test_parameters_of_all_nodes_need_no_section_of_its_own():
    """The file stays as short as its source."""
    sources = [ParameterSource(parameters={"a": 1}), ParameterSource(parameters={"b": 1})]
    assert merged_parameters(sources, OWN) == {"/**": {"a": 1, "b": 1}}
