"""Settings of the runtimes: few imports, and JSON in both directions."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.model.codec import from_plain, to_plain
from rosrm.model.values import ProcessSpec


def test_settings_and_registry_import_without_pydantic_yaml_or_typer():
    """The memory budget of a slave excludes modules that only files and terminals need."""
    code = (
        "import sys, rosrm.config.settings, rosrm.extensions.registry;"
        "print(*sorted({'pydantic', 'yaml', 'typer', 'rich', 'rclpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_state_directory_follows_the_name_and_xdg(monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/xdg")
    assert ClusterConfig(name="lab").state == Path("/xdg/rosrm/lab/master")
    assert HostConfig(host="lab").state == Path("/xdg/rosrm/lab/slave")


@dataclass(frozen=True)
class Inner:
    """A nested dataclass."""

    number: int = 1


@dataclass(frozen=True)
class Outer:
    """Options of every supported type."""

    text: str = ""
    ratio: float = 0.0
    path: Path = Path()
    maybe: int | None = None
    inner: Inner = field(default_factory=Inner)
    many: tuple[Inner, ...] = ()
    names: list[str] = field(default_factory=list)
    table: dict[str, Inner] = field(default_factory=dict)
    word: Literal["a", "b"] = "a"
    pair: tuple[int, str] = (1, "")


def test_plain_values_come_back_as_they_were():
    value = Outer("a", 1.5, Path("/x"), 3, Inner(2), (Inner(3),), ["b"], {"c": Inner(4)})
    assert from_plain(Outer, to_plain(value)) == value
    assert from_plain(Outer, {"ratio": 2}).ratio == 2.0
    assert from_plain(Outer, {"inner": [5]}).inner == Inner(5), "as `astuple` has it"


@pytest.mark.parametrize(
    ("plain", "said"),
    [
        ({"txt": "a"}, "unknown txt; allowed: text, ratio"),
        ({"text": 5}, "text: str is required, not 5"),
        ({"path": 5}, "path: text is required, not 5"),
        ({"ratio": True}, "ratio: float is required, not True"),
        ({"inner": 5}, "inner: a mapping is required, not 5"),
        ({"names": "abc"}, "names: a list is required, not 'abc'"),
        ({"table": {"a": 5}}, "table.a: a mapping is required, not 5"),
        ({"maybe": "x"}, "maybe: int is required, not 'x'"),
        ({"many": [{}, {"number": "x"}]}, "many[1].number: int is required, not 'x'"),
        ({"inner": {"nummer": 1}}, "inner: unknown nummer; allowed: number"),
        ({"inner": [1, 2]}, "inner: a mapping is required, not [1, 2]"),
        ({"word": "c"}, "word 'c'; allowed: a, b"),
        ({"pair": [1]}, "pair: a list of 2 is required, not [1]"),
    ],
)
def test_plain_values_of_another_shape_are_refused_by_name(plain, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        from_plain(Outer, plain)


def test_equal_parts_are_read_once_but_never_for_another_type():
    """A restart reads thousands of equal policies. `True` is refused although it equals 1."""
    first, second = (from_plain(Outer, {"inner": {"number": 1}}).inner for _ in range(2))
    assert first is second
    with pytest.raises(ValueError, match=r"inner\.number"):
        from_plain(Outer, {"inner": {"number": True}})


def test_parts_with_a_mapping_are_not_shared():
    """A plugin that changed the options of one process would change those of others."""
    plain = {"name": "p", "command": ["x"], "migration": {"options": {"list": [1]}}}
    first, second = (from_plain(ProcessSpec, plain).migration for _ in range(2))
    assert first == second
    assert first is not second


def test_what_json_cannot_carry_is_refused():
    with pytest.raises(TypeError, match="a value of type object cannot be carried as JSON"):
        to_plain(object())
