"""`rosrm plugin new`: the package of each kind works, and no name or folder is taken twice."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rosrm.cli.commands.plugin import Kind
from rosrm.cli.new_plugin import TEMPLATES, create_package
from rosrm.config.documents import read
from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry

NOTHING = Registry.of()
KINDS = [kind.value for kind in Kind]


def test_each_kind_has_a_template():
    assert sorted(KINDS) == sorted(path.name for path in TEMPLATES.iterdir() if path.is_dir())


def test_new_plugins_keep_their_contracts(tmp_path):
    """The tests of each package pass as they are, with names that are hard to rewrite."""
    names = ("none", "scores", "a-b_c2", "move", "rosrm")
    folders = [
        create_package(kind, name, tmp_path, NOTHING)
        for kind, name in zip(KINDS, names, strict=True)
    ]
    lines = [
        "import sys, pytest",
        f"sys.path[:0] = {[str(folder) for folder in folders]!r}",
        "sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider', *sys.argv[1:]]))",
    ]
    words = [sys.executable, "-c", "\n".join(lines), *map(str, folders)]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_of_the_template_s_name_is_left(kind, tmp_path):
    """All files are renamed, and the configuration names the plugin."""
    folder = create_package(kind, "my-own", tmp_path, NOTHING)
    for path in folder.iterdir():
        assert "example" not in (path.name + path.read_text(encoding="utf-8")).lower()
    settings = [read(path) for path in folder.glob("*.yaml")]
    assert any("my-own" in str(one.plain()) for one in settings)
    assert (folder / "rosrm_my_own.py").is_file()


@pytest.mark.parametrize(
    "name",
    ["", "A", "my plugin", "../x", "1st", "my--own", "own-", "_own", "é", "x" * 51, "a\n", "a.b"],
)
def test_a_name_that_cannot_be_used_is_refused(name, tmp_path):
    with pytest.raises(ConfigError, match="cannot be the name of a plugin"):
        create_package("scoring", name, tmp_path, NOTHING)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "name", "said"),
    [
        ("scoring", "weighted", "there is a scoring policy 'weighted' already"),
        ("probe", "memory", "there is a probe 'memory' already"),
        ("probe", "default", "there is a probe 'default' already"),
        ("filter", "scoring", "a distribution rosrm-scoring is installed already"),
        ("filter", "msgs", "a distribution rosrm-msgs is installed already"),
    ],
)
def test_a_name_that_is_taken_is_refused(kind, name, said, tmp_path):
    """Two plugins of one name would both be refused, and pip would replace the other package."""
    with pytest.raises(ConfigError, match=said):
        create_package(kind, name, tmp_path, Registry.discover())


@pytest.mark.parametrize("there", ["folder", "file", "dangling link"])
def test_what_exists_is_left_alone(there, tmp_path):
    target = tmp_path / "rosrm-mine"
    if there == "folder":
        target.mkdir()
    elif there == "file":
        target.write_text("mine", encoding="utf-8")
    else:
        target.symlink_to("nowhere")
    with pytest.raises(ConfigError, match="rosrm-mine exists already"):
        create_package("filter", "mine", tmp_path, NOTHING)
    assert [path.name for path in tmp_path.iterdir()] == ["rosrm-mine"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(ConfigError, match="rosrm-mine cannot be written: File exists"):
        create_package("filter", "mine", tmp_path / "file", NOTHING)


def test_the_folder_for_the_package_is_created(tmp_path):
    folder = create_package("filter", "mine", tmp_path / "a" / "b", NOTHING)
    assert folder == tmp_path / "a" / "b" / "rosrm-mine"
    assert [path.name for path in folder.parent.iterdir()] == ["rosrm-mine"]


def test_the_command_names_the_files_and_the_next_steps(rosrm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = rosrm("plugin", "new", "probe", "mine")
    assert done.code == 0
    assert done.out.splitlines() == [
        "created rosrm-mine: host.yaml, pyproject.toml, rosrm_mine.py, test_rosrm_mine.py",
        "next: cd rosrm-mine; pip install .; python -m pytest; rosrm config check host.yaml",
    ]
    assert rosrm("plugin", "new", "probe", "mine").code == 2
    assert Path("rosrm-mine").is_dir()
