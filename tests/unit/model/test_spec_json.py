"""A process spec as JSON, for the journal."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.model.codec import from_plain, to_plain
from rosrm.model.values import (
    Kind,
    MigrationPolicy,
    ProcessSpec,
    Readiness,
    RestartPolicy,
    StopPolicy,
)

text = st.text(max_size=8)
numbers = st.floats(allow_nan=False, allow_infinity=False)
words = st.dictionaries(text, text, max_size=3)
scalars = st.booleans() | st.integers(-(2**53), 2**53) | numbers | text
parameters = st.dictionaries(text, scalars | st.lists(scalars, max_size=3), max_size=3)
options = st.dictionaries(text, st.recursive(scalars, lambda inner: st.lists(inner, max_size=2)))

specs = st.builds(
    ProcessSpec,
    name=text,
    namespace=text,
    package=st.none() | text,
    executable=st.none() | text,
    module=st.none() | text,
    command=st.lists(text, max_size=3).map(tuple),
    arguments=st.lists(text, max_size=3).map(tuple),
    parameters=parameters,
    remappings=words,
    environment=words,
    working_directory=st.none() | text,
    ros=st.booleans(),
    kind=st.sampled_from(Kind),
    restart=st.builds(RestartPolicy, text, numbers, numbers, numbers, st.integers(0, 9), numbers),
    needs=st.dictionaries(text, numbers, max_size=3),
    required_labels=words,
    preferred_labels=words,
    avoided_labels=words,
    priority=st.integers(-(2**31), 2**31 - 1),
    migration=st.builds(MigrationPolicy, st.none() | text, st.booleans(), options),
    readiness=st.builds(Readiness, text, numbers),
    stop=st.builds(StopPolicy, numbers, numbers),
)


@given(specs)
def test_a_spec_comes_back_from_json_as_it_was(spec):
    assert from_plain(ProcessSpec, json.loads(json.dumps(to_plain(spec)))) == spec


def test_an_older_record_gets_the_defaults_of_what_it_lacks():
    assert from_plain(ProcessSpec, {"name": "a"}) == ProcessSpec("a")


def test_a_field_of_a_newer_version_is_refused_not_dropped():
    with pytest.raises(ValueError, match=r"^unknown colour; allowed: name, "):
        from_plain(ProcessSpec, {"name": "a", "colour": 1})
    with pytest.raises(ValueError, match=r"^restart: unknown colour; allowed: when, "):
        from_plain(ProcessSpec, {"name": "a", "restart": {"colour": 1}})
