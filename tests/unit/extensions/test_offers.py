"""Offers whose fields have another type or range than declared are broken, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rosrm.errors import PluginError
from rosrm.extensions.answers import MOST_VALUES, whole
from rosrm.extensions.contracts import (
    Capabilities,
    CheckpointOffer,
    FilterOffer,
    LauncherOffer,
    MigrationOffer,
    ProbeOffer,
    ScoringOffer,
)
from rosrm.extensions.discovery import HOOKS
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.registry import Registry
from rosrm.extensions.sinks import SinkOffer
from rosrm.model.rows import PluginKind

OFFERS: dict[PluginKind, Any] = {
    "probe": ProbeOffer("x", print, resources=("x",)),
    "scoring": ScoringOffer("x", print),
    "filter": FilterOffer("x", print),
    "migration": MigrationOffer("x", print),
    "checkpoint": CheckpointOffer("x", print),
    "launcher": LauncherOffer("x", print),
    "sink": SinkOffer("x", print),
}
HOOK_OF = {kind: hook for hook, (kind, _) in HOOKS.items()}
WRONG: list[tuple[PluginKind, str, Any]] = [
    *(("probe", "period", value) for value in ("0.5s", math.nan, math.inf, 0.0, -1.0, None, True)),
    *(("probe", "deadline", value) for value in (None, math.nan, 0.0, "1")),
    ("probe", "default", "yes"),
    ("probe", "resources", (1,)),
    ("scoring", "reads", ("name", 3)),
    ("filter", "permanent", 1),
    ("migration", "capabilities", Capabilities(launcher=None)),  # type: ignore[arg-type]
    ("migration", "capabilities", Capabilities(shadow="no")),  # type: ignore[arg-type]
    ("migration", "own_options", 3),
    ("migration", "host_options", None),
    ("launcher", "variables", None),
    ("launcher", "variables", ("A=B",)),
    ("launcher", "variables", "ABC"),
    *(("sink", "batch", value) for value in (0, -1, 1.5, None, True, 10**9)),
    *((kind, "summary", None) for kind in OFFERS),
    *((kind, "summary", "\ud800") for kind in OFFERS),
    *((kind, "name", value) for kind in OFFERS for value in (None, "", "a b", "x" * 65, 3)),
    *((kind, "create", None) for kind in OFFERS),
]


def registry_of(kind: PluginKind, answer: Callable[[], Any]) -> Registry:
    hook = HOOK_OF[kind]
    return Registry.of(odd=SimpleNamespace(**{hook: hookimpl(specname=hook)(answer)}))


@pytest.mark.parametrize(("kind", "field", "value"), WRONG)
def test_an_offer_with_a_wrong_field_is_broken(kind: PluginKind, field: str, value: Any) -> None:
    """The reason names the field; the offer cannot end a part at its start."""
    offer = replace(OFFERS[kind]) if field == "resources" else OFFERS[kind]
    offer = replace(offer)
    object.__setattr__(offer, field, value)
    registry = registry_of(kind, lambda: [offer])
    assert registry.names(kind) == ()
    (row,) = registry.rows()
    assert row.state == "broken"
    assert row.reason.isprintable()


@pytest.mark.parametrize("kind", OFFERS)
def test_a_correct_offer_is_taken(kind: PluginKind) -> None:
    """The check refuses no offer with its declared types."""
    assert registry_of(kind, lambda: [OFFERS[kind]]).names(kind) == ("x",)


class Endless(list):  # type: ignore[type-arg]
    def __iter__(self) -> Any:
        while True:
            yield OFFERS["scoring"]


class Raising(list):  # type: ignore[type-arg]
    def __len__(self) -> int:
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    "answer", [Endless(), Raising(), None, 3, "x", {}, [None], [object()], iter([]), 300 * [1]]
)
def test_a_hook_with_a_wrong_answer_is_broken(answer: Any) -> None:
    """Iterators without end and lists that raise are faults of the plugin, too."""
    registry = registry_of("scoring", lambda: answer)
    assert registry.names("scoring") == ()


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), SystemExit(1), GeneratorExit()])
@pytest.mark.parametrize("kind", OFFERS)
def test_whatever_a_hook_raises_breaks_its_plugin_alone(
    kind: PluginKind, fault: BaseException
) -> None:
    """Each part and each command starts without the plugin."""

    def register() -> None:
        raise fault

    (broken,) = registry_of(kind, register).broken
    assert type(fault).__name__ in broken.reason


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), SystemExit(1), GeneratorExit()])
def test_whatever_create_raises_is_a_fault_of_the_plugin(fault: BaseException) -> None:
    """The creation of an object fails with the place of `create`."""

    def create(_options: object) -> None:
        raise fault

    registry = registry_of("scoring", lambda: [ScoringOffer("x", create)])
    with pytest.raises(PluginError, match=rf"`create` \({__file__}:\d+\) raised"):
        registry.scoring("x")


def test_values_of_any_form_are_checked_with_all_their_parts() -> None:
    """A fault names the path to the value."""
    for value, hint, fault in (
        ({"a": [1, "x"]}, dict[str, list[int]], r"it\['a'\]\[1\] is 'x'; int is required"),
        ((1.0, math.nan), tuple[float, ...], r"it\[1\] is nan"),
        (Capabilities(state="odd"), Capabilities, r"it\.state is 'odd'"),  # type: ignore[arg-type]
        ([0] * (MOST_VALUES + 1), list[int], "more than"),
    ):
        with pytest.raises(PluginError, match=fault):
            whole(value, hint)
    assert whole(None, int | None) is None
