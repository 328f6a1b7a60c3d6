"""Setting `security` of master, slave and clients."""

from __future__ import annotations

import pytest

from rosrm.client.connecting import security_mode
from rosrm.config.cluster import load_cluster
from rosrm.config.host import load_host
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.errors import ConfigError


@pytest.fixture(autouse=True)
def _no_file_of_the_environment(monkeypatch):
    for variable in ("ROSRM_CLUSTER", "ROSRM_SECURITY"):
        monkeypatch.delenv(variable, raising=False)


@pytest.mark.parametrize(
    ("word", "mode"), [(None, "keys"), ("", "keys"), ("keys", "keys"), ("none", "none")]
)
def test_the_variable_gives_the_default(monkeypatch, file, word, mode):
    """Without the variable messages are sealed."""
    if word is not None:
        monkeypatch.setenv("ROSRM_SECURITY", word)
    assert ClusterConfig().security == load_cluster(file("name: a")).security == mode
    assert HostConfig().security == load_host(file("host: a")).security == mode
    assert security_mode() == mode


@pytest.mark.parametrize(("word", "mode"), [("keys", "none"), ("none", "keys")])
def test_the_file_takes_precedence(monkeypatch, file, word, mode):
    """The file is more specific than the variable; the runtimes receive its value."""
    monkeypatch.setenv("ROSRM_SECURITY", word)
    path = file(f"security: {mode}")
    cluster, host = load_cluster(path), load_host(path)
    assert (cluster.security, host.security) == (mode, mode)
    assert ClusterConfig.from_json(cluster.to_json()).security == mode
    assert HostConfig.from_json(host.to_json()).security == mode
    assert security_mode(path) == mode
    monkeypatch.setenv("ROSRM_CLUSTER", str(path))
    assert security_mode() == mode


@pytest.mark.parametrize("text", ["security: off", "security: null", "security: false"])
@pytest.mark.parametrize("loader", [load_cluster, load_host])
def test_another_word_in_a_file_is_refused(refusal, text, loader):
    """No word turns security off by mistake."""
    assert "f.yaml:1:11: security: " in refusal(loader, text)


@pytest.mark.parametrize("word", ["None", "off", "0"])
def test_another_word_in_the_variable_is_refused(monkeypatch, word):
    """The message names the allowed words."""
    monkeypatch.setenv("ROSRM_SECURITY", word)
    for made in (ClusterConfig, HostConfig, security_mode):
        with pytest.raises(ConfigError, match=f"ROSRM_SECURITY='{word}'; allowed: keys, none"):
            made()
