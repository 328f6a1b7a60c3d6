"""YAML with places: unreadable text is refused with line and column."""

from __future__ import annotations

import pytest

from rosrm.config.documents import Place, parse, read
from rosrm.errors import ConfigError
from tests.launch_files import FILES


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as refused:
        parse(text, "f.yaml")
    return str(refused.value)


def test_every_value_and_key_has_its_place():
    root = parse("a: 1\nb:\n  - x\n  - {c: true}\n", "f.yaml")
    assert root.plain() == {"a": 1, "b": ["x", {"c": True}]}
    assert root.get("b", 1, "c").place == Place("f.yaml", 4, 9)
    assert root.get("b", 1, "c").key_place == Place("f.yaml", 4, 6)
    assert root.deepest(("b", 1, "zz")).place == Place("f.yaml", 4, 5)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("yes", "yes"),
        ("on", "on"),
        ("true", True),
        ("010", 10),
        ("0x1F", 31),
        ("1e3", 1000.0),
        ("10:30", "10:30"),
        ("2024-01-01", "2024-01-01"),
        ("~", None),
        ("1_000", "1_000"),
        ('"5"', "5"),
    ],
)
def test_plain_words_are_those_of_yaml_1_2(text, value):
    assert parse(f"a: {text}", "f").plain() == {"a": value}


def test_unreadable_yaml_is_refused_with_line_and_column():
    assert refusal("a: [1, 2\nb: 3\n").startswith("f.yaml:2:2: unreadable YAML: ")
    assert refusal("a: 'x\n").startswith("f.yaml:2:1: unreadable YAML: ")
    assert "f.yaml:1:4: unreadable YAML: the character #x0007" in refusal("a: \x07")


@pytest.mark.parametrize("name", ["events.launch.py", "sensors.launch.xml", "tools.launch.yaml"])
def test_a_launch_file_is_refused_with_the_command_that_runs_it(name):
    """`rosrm apply`, `submit` and `up` get such files from users of `ros2 launch`."""
    file = FILES / name
    with pytest.raises(ConfigError, match=f"launch file of ROS 2; use `rosrm launch {file}`"):
        read(file)


def test_a_key_given_twice_is_refused_with_both_places():
    assert refusal("a: 1\nb: 2\na: 3\n") == (
        "f.yaml:3:1: the key 'a' is given twice, first at line 1, column 1"
    )


def test_every_fault_of_form_is_reported_at_once():
    said = refusal("a: 1\na: 2\n3: x\nc: !!python/name:os.system y\n")
    assert said.startswith("3 errors in f.yaml\n")
    assert "f.yaml:3:1: a key must be text, and '3' is not; put it in quotes" in said
    assert "f.yaml:4:4: the tag 'tag:yaml.org,2002:python/name:os.system' is not allowed" in said


def test_aliases_work_and_cannot_run_wild():
    assert parse("a: &x {b: 1}\nc: *x\n", "f").plain() == {"a": {"b": 1}, "c": {"b": 1}}
    assert "an alias that contains itself" in refusal("a: &x [*x]\n")
    bomb = "a0: &a0 [1, 1]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 8)
    )
    assert "more than 200000 values" in refusal(bomb)


def test_more_than_one_document_and_deep_nesting_are_refused():
    assert "unreadable YAML" in refusal("a: 1\n---\nb: 2\n")
    assert "nested too deeply" in refusal("[" * 5000)


def test_an_empty_document_is_an_empty_mapping():
    assert parse("# nothing\n", "f").plain() == {}


def test_what_cannot_be_read_as_a_file_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match=r"none.yaml: cannot be read: No such file"):
        read(tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"a: 1\nb: caf\xe9\n")
    with pytest.raises(ConfigError, match=r"latin.yaml:2:7: not UTF-8 text"):
        read(tmp_path / "latin.yaml")


def test_a_file_that_is_too_large_is_refused_at_once(tmp_path):
    """A file that never ends is refused, too; none of it is read as YAML."""
    with pytest.raises(ConfigError, match=r"/dev/zero: it has more than 16 MiB, so it is probably"):
        read("/dev/zero")


def test_a_file_of_too_many_values_is_not_read_to_its_end(monkeypatch):
    """The file is refused before its rest is read, which is not valid YAML."""
    monkeypatch.setattr("rosrm.config.documents.MOST_VALUES", 100)
    said = refusal("- 1\n" * 300 + "[")
    assert "f.yaml:20" in said
    assert "more than 100 values" in said


def test_mappings_are_merged_as_in_yaml_1_1():
    """Keys beside `<<` count first, then the first base that has a key."""
    text = (
        "x-a: &a {one: 1, two: 1}\nx-b: &b {<<: *a, two: 2, three: 2}\n"
        "p: {two: 3, <<: *b}\nq: {<<: [*a, *b]}\nr: {'<<': 1}\n"
    )
    assert parse(text, "f.yaml").plain() == {
        "p": {"one": 1, "two": 3, "three": 2}, "q": {"one": 1, "two": 1, "three": 2},
        "r": {"<<": 1},
    }  # fmt: skip
    assert "f.yaml:1:5: <<: a mapping is required" in refusal("<<: 3\n")


def test_keys_of_users_are_left_to_them_at_the_top_of_a_file_only():
    assert parse("x-mine: 1\np: {x-mine: 2}\n", "f.yaml").plain() == {"p": {"x-mine": 2}}
