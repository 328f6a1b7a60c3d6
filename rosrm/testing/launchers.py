"""Contract of launchers with the slave."""

from __future__ import annotations

import os
import shutil
import sys
import weakref
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import ClassVar
from unittest import SkipTest

from rosrm.extensions.contracts import (
    GraphDepartureLauncher,
    ImageLauncher,
    Launch,
    Launcher,
    LauncherContext,
    LauncherOffer,
    ProcessTreeLauncher,
)
from rosrm.extensions.plugin_calls import implements, required
from rosrm.extensions.time_limit import CALL_LIMIT
from rosrm.model.values import Assignment, InstanceId, ProcessSpec
from rosrm.slave.launch.launchers import PREPARE_LIMIT
from rosrm.testing.calls import ContractBroken, call, registry_of


class LauncherContract:
    """Contract of a launcher with the slave.

    Attributes:
        offer: the tested offer.
        spec: of a process whose strategy declares this launcher.
    """

    offer: ClassVar[LauncherOffer]
    spec: ClassVar[ProcessSpec] = ProcessSpec("p", command=("sleep", "60"))

    def make(self) -> Launcher:
        """Return a new launcher of a slave with an empty directory, removed after the test."""
        folder = Path(mkdtemp(prefix="rosrm-"))
        weakref.finalize(self, shutil.rmtree, folder)
        context = LauncherContext(folder, sys.executable, 1)
        found = registry_of("launcher", self.offer).launchers(context)
        if found.absent:
            raise SkipTest(f"{self.offer.name} is absent: {found.absent[self.offer.name]}")
        if found.broken:
            raise ContractBroken(found.broken[self.offer.name])
        return found.made[self.offer.name].launcher

    def launch(self, number: int = 1, *, restored: bool = False) -> Launch:
        """Return the start of one instance, as the slave has it before any launcher."""
        instance = InstanceId(self.spec.name, number)
        assignment = Assignment(instance, self.spec, 1, self.spec.name, restored=restored)
        return Launch(assignment, "rosrm", self.spec.command, {"PATH": os.environ["PATH"]})

    def _prepared(self, launcher: Launcher, launch: Launch) -> Launch | None:
        """Return what a launcher prepares; the limit and the check are those of the slave."""

        def ask() -> Launch | None:
            prepared = launcher.prepare(launch)
            return None if prepared is None else required(prepared, Launch)

        return call("prepare", PREPARE_LIMIT, ask, launcher)

    def test_prepares_a_command_line_of_text(self) -> None:
        """The launcher returns a command line and an environment of text for the supervisor."""
        prepared = self._prepared(self.make(), self.launch())
        if prepared is not None:
            assert prepared.argv, "the command line is empty"
            assert all(isinstance(word, str) for word in prepared.argv), prepared.argv
            for item in prepared.environment.items():
                assert all(isinstance(text, str) for text in item), f"environment: {item}"

    def test_starts_the_same_instance(self) -> None:
        """The launcher does not change the assignment."""
        launch = self.launch()
        prepared = self._prepared(self.make(), launch)
        assert prepared is None or prepared.assignment == launch.assignment

    def test_denies_instances_of_other_launchers(self) -> None:
        """The launcher answers no for any process that it has not started."""
        launcher: object = self.make()
        if implements(launcher, ProcessTreeLauncher):
            leads = call("leads", CALL_LIMIT, partial(launcher.leads, os.getpid()))
            assert leads is False, f"leads answered {leads} for another process"
        if implements(launcher, GraphDepartureLauncher):
            gone = call("has_departed", CALL_LIMIT, partial(launcher.has_departed, os.getpid()))
            assert gone is False, f"has_departed answered {gone} for another process"

    def test_discards_images_that_are_not_there(self) -> None:
        """The launcher accepts an instance without images: a user may restart any process."""
        launcher: object = self.make()
        if implements(launcher, ImageLauncher):
            instance = InstanceId(self.spec.name, 999)
            call("discard_images", CALL_LIMIT, partial(launcher.discard_images, instance))
