"""Default scope of a slave's readings."""

from __future__ import annotations

import pytest

from rosrm.config.host import load_host
from rosrm.config.settings import HostConfig
from rosrm.errors import ConfigError


@pytest.mark.parametrize(
    ("word", "scope"), [(None, "machine"), ("", "machine"), ("cgroup", "cgroup")]
)
def test_the_variable_gives_the_default(monkeypatch, file, word, scope):
    """A lab sets the variable, so that its slaves need no file, or none with a scope."""
    monkeypatch.delenv("ROSRM_SCOPE", raising=False)
    if word is not None:
        monkeypatch.setenv("ROSRM_SCOPE", word)
    assert HostConfig().scope == load_host(file("host: a")).scope == scope


def test_the_file_takes_precedence(monkeypatch, file):
    """The file is more specific than the variable."""
    monkeypatch.setenv("ROSRM_SCOPE", "cgroup")
    assert load_host(file("scope: machine")).scope == "machine"


@pytest.mark.parametrize("word", ["slice", "Cgroup", "x"])
def test_a_wrong_scope_is_refused(monkeypatch, refusal, word):
    """A slice needs a budget, which the variable cannot give."""
    monkeypatch.setenv("ROSRM_SCOPE", word)
    assert f"ROSRM_SCOPE={word!r}; allowed: machine, cgroup" in refusal(load_host, "host: a")
    with pytest.raises(ConfigError, match="allowed: machine, cgroup"):
        HostConfig()
