"""Every shipped launcher holds the contract that a third party's holds."""

from rosrm.model.values import MigrationPolicy, ProcessSpec
from rosrm.testing import LauncherContract
from rosrm_criu import plugin

OFFERS = {offer.name: offer for offer in plugin.register_launchers()}


class TestCriu(LauncherContract):
    offer = OFFERS["criu"]
    spec = ProcessSpec("p", command=("sleep", "60"), ros=True, migration=MigrationPolicy("criu"))


def test_each_shipped_launcher_is_here():
    """A launcher that is added to a plugin must be added here."""
    assert set(OFFERS) <= {contract.offer.name for contract in LauncherContract.__subclasses__()}
