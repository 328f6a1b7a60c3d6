"""An answer of a plugin leaves the guard as a copy in exactly its declared types."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import Mock

import pytest

from rosrm.errors import PluginError
from rosrm.extensions.answers import exact, whole
from rosrm.extensions.contracts import (
    Capabilities,
    LauncherOffer,
    MigrationOffer,
    ProbeContext,
    ProbeOffer,
)
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.plugin_calls import required
from rosrm.extensions.registry import Registry
from rosrm.model.devices import Device
from rosrm.model.values import ProcessSpec, Reading, ResourceDescription
from rosrm.slave.probe_reads import read_devices, read_processes


class OddText(str):
    """A text whose methods are the plugin's."""

    __slots__ = ()

    def _raise(self, *_: Any) -> Any:
        raise RuntimeError("out of order")

    __format__ = __str__ = __repr__ = encode = isprintable = _raise  # type: ignore[assignment]


class OddNumber(int):
    """A number that seems to lie in any range."""

    def __gt__(self, _other: object) -> bool:
        return True

    __lt__ = __ge__ = __le__ = __gt__  # type: ignore[assignment]

    def __format__(self, _form: str) -> str:
        raise RuntimeError("out of order")


class OddFraction(float):
    def __float__(self) -> float:
        return 7.0


@dataclass(frozen=True)
class OddCapabilities(Capabilities):
    """Capabilities that the plugin computes at each access."""

    def __getattribute__(self, name: str) -> Any:
        return OddText("ours") if name == "launcher" else super().__getattribute__(name)


class Changing(Mapping[str, int]):
    """A mapping that has other items each time."""

    def __init__(self) -> None:
        self._numbers = count()

    def __getitem__(self, key: str) -> int:
        return next(self._numbers)

    def __iter__(self) -> Iterator[str]:
        return iter((f"key{next(self._numbers)}",))

    def __len__(self) -> int:
        return 1


def _kinds(value: Any) -> set[type]:
    if isinstance(value, Mapping):
        return {type(value)}.union(*(_kinds(key) | _kinds(value[key]) for key in value))
    if isinstance(value, list | tuple):
        return {type(value)}.union(*map(_kinds, value))
    return {type(value)}


@pytest.mark.parametrize(
    ("answer", "hint", "kinds"),
    [
        (OddText("x"), str, {str}),
        (OddNumber(3), int, {int}),
        (OddFraction(0.5), float, {float}),
        ([OddNumber(3)], Sequence[int], {tuple, int}),
        ((OddText("x"), OddNumber(3)), tuple[str, int], {tuple, str, int}),
        ({OddText("x"): [OddNumber(3)]}, Mapping[str, list[int]], {dict, str, list, int}),
        (Changing(), Mapping[str, int], {dict, str, int}),
        (OddCapabilities(), Capabilities, {Capabilities}),
    ],
    ids=["text", "number", "fraction", "list", "tuple", "mapping", "changing", "dataclass"],
)
def test_a_copy_has_no_methods_of_the_plugin(answer: Any, hint: Any, kinds: set[type]) -> None:
    """Otherwise code of the plugin would run wherever rosrm formats or compares the value."""
    copied = whole(answer, hint)
    assert _kinds(copied) == kinds
    assert _kinds(copied) == kinds  # also when it is read again


def test_a_copy_has_the_value_of_the_base_type() -> None:
    """The copy does not call methods of the plugin either."""
    assert whole(OddFraction(0.5), float) == 0.5
    assert exact(OddNumber(3)) == 3
    assert whole(OddCapabilities(), Capabilities).launcher == "ours"


def test_an_object_that_claims_a_type_has_another_one() -> None:
    """A mock with a specification passes `isinstance`."""
    with pytest.raises(PluginError, match="Capabilities is required"):
        whole(Mock(spec=Capabilities), Capabilities)
    with pytest.raises(PluginError, match="Capabilities is required"):
        required(Mock(spec=Capabilities), Capabilities)


def _registry(offer: Any, hook: str) -> Registry:
    return Registry.of(odd=SimpleNamespace(**{hook: hookimpl(specname=hook)(lambda: [offer])}))


def test_an_offer_stays_as_it_was_registered() -> None:
    """A plugin that changes its offer later changes neither executors nor capabilities."""
    executors: dict[Any, Any] = {OddText("ours.step"): dict}
    offer = MigrationOffer(
        OddText("ours"), print, executors=executors, capabilities=OddCapabilities()
    )
    registry = _registry(offer, "register_migration_strategies")
    executors.clear()
    executors[3] = None
    object.__setattr__(offer, "capabilities", None)
    ((name, executor),) = registry.executors().items()
    assert (type(name), name, executor.strategy) == (str, "ours.step", "ours")
    assert registry.capabilities() == {"ours": Capabilities(launcher="ours")}
    assert {type(one) for one in registry.names("migration")} == {str}
    assert registry.capabilities_of()(ProcessSpec("p")) == Capabilities()


def test_the_variables_of_a_launcher_are_those_of_its_registration() -> None:
    """The variables are copied at registration, because each start of a process reads them."""
    offer = LauncherOffer("ours", lambda _: SimpleNamespace(prepare=None), variables=("X",))
    object.__setattr__(offer, "variables", Variables())
    registry = _registry(offer, "register_launchers")
    Variables.items.append(3)  # type: ignore[arg-type]
    assert registry.launchers(None).made["ours"].variables == ("OURS",)  # type: ignore[arg-type]


class Variables(tuple):  # type: ignore[type-arg] # noqa: SLOT001
    """A tuple with the items of a list."""

    items: ClassVar[list[str]] = ["OURS"]

    def __iter__(self) -> Iterator[str]:
        return iter(self.items)


class OddProbe:
    """A probe whose description and labels have methods of its own."""

    resources = (ResourceDescription(OddText("x"), OddText("1"), OddFraction(0.5), "machine"),)
    labels: ClassVar = {OddText("room"): OddText("lab")}

    def read(self) -> list[Reading]:
        return [Reading("x", 0.5)]

    def close(self) -> None:
        """Do nothing."""


def test_resources_and_labels_of_a_probe_have_no_methods_of_the_plugin(tmp_path: Any) -> None:
    """Resources and labels are copies, because the slave sends both with each registration."""
    registry = _registry(ProbeOffer("x", lambda *_: OddProbe()), "register_probes")
    context = ProbeContext("machine", {}, tmp_path, None)  # type: ignore[arg-type]
    (made,) = registry.probes({"x": {}}, context).made
    (resource,) = made.resources
    assert _kinds([*vars_of(resource), made.labels]) <= {list, str, float, dict}
    assert resource.capacity == 0.5


def vars_of(value: Any) -> list[Any]:
    return [getattr(value, name) for name in ("name", "unit", "capacity", "scope", "accounting")]


class Growing(dict):  # type: ignore[type-arg]
    """A mapping to which a thread of the probe adds an item while the slave reads it."""

    def items(self) -> Any:
        self["odd"] = {}
        return super().items()


def test_usage_is_taken_of_the_announced_resources_alone() -> None:
    """Another name would end the loop, which looks for its slot."""
    probe = SimpleNamespace(by_process=lambda: Growing(x={1: 2.0}))
    described = [ResourceDescription("x", "1", 1.0, "machine")]
    assert read_processes(probe, described) == {"x": {1: 2.0}}


def test_devices_have_no_methods_of_the_plugin() -> None:
    """The texts of devices are copies, because registrations and listings have them."""
    found = Device("gpu", OddText("a"), about=OddText("fast"))
    (device,) = read_devices(SimpleNamespace(devices=lambda: [found]))
    assert (type(device.unit), type(device.about)) == (str, str)
