"""Loaders on arbitrary input: the result is a value or one `ConfigError`."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import fields

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.config.cluster import load_cluster
from rosrm.config.host import load_host
from rosrm.config.process import (
    LabelsInFile,
    MigrationInFile,
    ProcessInFile,
    ReadinessInFile,
    RestartInFile,
)
from rosrm.config.ros import DiscoveryInFile, RosInFile
from rosrm.config.settings import ClusterConfig, HostConfig, MigrationSettings, ScoringChoice
from rosrm.config.work import load_work
from rosrm.errors import ConfigError

KINDS = (
    ClusterConfig, HostConfig, MigrationSettings, ScoringChoice, RosInFile, DiscoveryInFile,
    ProcessInFile, LabelsInFile, MigrationInFile, ReadinessInFile, RestartInFile,
)  # fmt: skip
KEYS = sorted(
    {f.name for kind in KINDS for f in fields(kind)}
    | {"processes", "foreach", "memory", "cpu", "i"}
)
WORDS = ["", "a", "{i}", "{", "range(3)", "5s", "2GiB", "slice", "relaunch", "x 'y", "job"]

scalars = st.none() | st.booleans() | st.integers(-3, 3) | st.floats() | st.sampled_from(WORDS)
values = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4)
    ),
    max_leaves=12,
)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("any") / "f.yaml"


@pytest.mark.parametrize("load", [load_cluster, load_host, load_work])
@given(root=st.dictionaries(st.sampled_from(KEYS), values, max_size=6))
@settings(max_examples=60, deadline=None)
def test_any_document_is_taken_or_refused(path, load, root):
    path.write_text(json.dumps(root), encoding="utf-8")
    with suppress(ConfigError):
        load(path)


@given(root=st.lists(st.dictionaries(st.sampled_from(KEYS), values, max_size=6), min_size=1))
@settings(max_examples=60, deadline=None)
def test_any_list_of_processes_is_taken_or_refused(path, root):
    path.write_text(json.dumps({"processes": root}), encoding="utf-8")
    with suppress(ConfigError):
        load_work(path)


@pytest.mark.parametrize("load", [load_cluster, load_host, load_work])
@given(content=st.binary(max_size=20) | st.text(max_size=40).map(str.encode))
@settings(max_examples=150, deadline=None)
def test_any_text_and_any_bytes_are_taken_or_refused(path, load, content):
    path.write_bytes(content)
    with suppress(ConfigError):
        load(path)
