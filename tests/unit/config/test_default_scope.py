"""Default scope of a slave's readings."""

from __future__ import annotations

import pytest

from rosrm.config import HostConfig, load_host
from rosrm.errors import ConfigError


@pytest.mark.parametrize(
    ("word", "scope"), [(None, "machine"), ("", "machine"), ("cgroup", "cgroup")]
)
def test_the_variable_gives_the_default(monkeypatch, tmp_path, word, scope):
    """A lab sets the variable, so that its slaves need no file, or none with a scope."""
    monkeypatch.delenv("ROSRM_SCOPE", raising=False)
    if word is not None:
        monkeypatch.setenv("ROSRM_SCOPE", word)
    (tmp_path / "h.yaml").write_text("host: a\n")
    assert HostConfig().scope == scope
    assert load_host(tmp_path / "h.yaml").scope == scope


def test_the_file_has_the_last_word(monkeypatch, tmp_path):
    """The file is more specific than the variable."""
    monkeypatch.setenv("ROSRM_SCOPE", "cgroup")
    (tmp_path / "h.yaml").write_text("scope: machine\n")
    assert load_host(tmp_path / "h.yaml").scope == "machine"


@pytest.mark.parametrize("word", ["slice", "Cgroup", "x"])
def test_a_wrong_word_is_refused(monkeypatch, tmp_path, word):
    """A slice needs a budget, which the variable cannot give."""
    monkeypatch.setenv("ROSRM_SCOPE", word)
    (tmp_path / "h.yaml").write_text("host: a\n")
    with pytest.raises(ConfigError, match=f"ROSRM_SCOPE={word!r}; allowed: machine, cgroup"):
        load_host(tmp_path / "h.yaml")
    with pytest.raises(ConfigError, match="allowed: machine, cgroup"):
        HostConfig()
