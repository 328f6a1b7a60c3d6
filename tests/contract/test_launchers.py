"""Every shipped launcher holds the contract that a third party's holds."""

import pytest

import rosrm_container.plugin
import rosrm_criu.plugin
from rosrm.model.values import Container, MigrationPolicy, ProcessSpec
from rosrm.testing import LauncherContract
from tests.podman_kit import IMAGE, podman  # noqa: F401 - a fixture

PLUGINS = (rosrm_container.plugin, rosrm_criu.plugin)
OFFERS = {offer.name: offer for plugin in PLUGINS for offer in plugin.register_launchers()}


class TestCriu(LauncherContract):
    offer = OFFERS["criu"]
    spec = ProcessSpec("p", command=("sleep", "60"), ros=True, migration=MigrationPolicy("criu"))


@pytest.mark.usefixtures("podman")
class TestPodman(LauncherContract):
    offer = OFFERS["podman"]
    spec = ProcessSpec("p", command=("sleep", "60"), container=Container(IMAGE, "podman"))


def test_each_shipped_launcher_is_here():
    """A launcher that is added to a plugin must be added here."""
    assert set(OFFERS) <= {contract.offer.name for contract in LauncherContract.__subclasses__()}
