"""Calls of a plugin by its contract, with the time limits and checks of master and slave."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, Final, TypeVar
from unittest import SkipTest

from rosrm.config.checking import validated
from rosrm.config.documents import Problems, parse
from rosrm.errors import ConfigError, PluginError, place_in_plugin
from rosrm.extensions.discovery import HOOKS, ChosenOffer, Offer
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.made import FailedProbe
from rosrm.extensions.plugin_calls import with_place
from rosrm.extensions.registry import Registry
from rosrm.extensions.time_limit import limited
from rosrm.model.codec import to_plain
from rosrm.model.rows import PluginKind

T = TypeVar("T")

_HOOK_OF: Final = {kind: hook for hook, (kind, _) in HOOKS.items()}


class ContractBroken(AssertionError):
    """Violation of a contract by a plugin, with a description."""


def call(hook: str, seconds: float, ask: Callable[[], T], of: object = None) -> T:
    """Return the answer of a plugin.

    Args:
        hook: name of the called hook, for messages.
        seconds: time limit of master or slave for this call.
        ask: calls the hook and checks the answer; raises `PluginError` for a wrong one.
        of: the object with the hook, whose place the message about a wrong answer has.

    Raises:
        ContractBroken: the call exceeded its limit, or its answer is wrong.
    """
    late = ""

    def expired() -> str:
        nonlocal late
        late = f"{hook} took longer than {seconds:g} s, which is its limit in rosrm"
        return late

    try:
        return limited(seconds, ask, expired)
    except Exception as fault:
        if late:
            place = place_in_plugin(fault)
            raise ContractBroken(f"{late}, at {place}" if place else late) from fault
        if isinstance(fault, PluginError):
            raise ContractBroken(f"{hook}: {with_place(fault, of, hook)}") from None
        raise


def checked_options(wanted: type[Any], given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return options as `rosrm config check` reads them from a file, as plain values.

    Raises:
        ContractBroken: a name is unknown, or a value is not allowed.
    """
    problems = Problems()
    value = validated(wanted, parse(json.dumps(to_plain(given)), "options"), problems)
    if value is None:
        raise ContractBroken("; ".join(f"options: {text}" for _, text in problems.found))
    return dict(to_plain(value))


def registry_of(kind: PluginKind, offer: Offer) -> Registry:
    """Return a registry with one offer; raises `ContractBroken` if the offer is wrong."""
    hook = _HOOK_OF[kind]
    plugin = SimpleNamespace(**{hook: hookimpl(specname=hook)(lambda: [offer])})
    registry = Registry.of(tested=plugin)
    if registry.broken:
        raise ContractBroken(registry.broken[0].reason)
    return registry


def made(kind: PluginKind, offer: ChosenOffer, options: Mapping[str, Any], *context: Any) -> Any:
    """Return the object of an offer, created and checked as by master or slave.

    Args:
        kind: of the plugin.
        offer: of the plugin.
        options: in the form of a file.
        context: of a probe.

    Raises:
        ContractBroken: the offer or its object is wrong.
        SkipTest: the plugin reports itself absent on this host.
    """
    registry = registry_of(kind, offer)
    name, plain = offer.name, checked_options(offer.options, options)
    try:
        if kind == "probe":
            probes = [one.probe for one in registry.probes({name: plain}, *context).made]
            thing: Any = next((one for one in probes if not isinstance(one, FailedProbe)), None)
        elif kind == "filter":
            thing = registry.filters({name: plain})[0].filter
        elif kind == "migration":
            thing = registry.migrations({name: plain})[name]
        else:
            thing = getattr(registry, kind)(name, plain)
    except (ConfigError, PluginError):
        thing = None
    (row,) = registry.rows(kind)
    if row.state == "absent":
        raise SkipTest(f"{name} is absent here: {row.reason}")
    if thing is None:
        raise ContractBroken(row.reason)
    return thing


def as_json(what: str, value: object) -> Mapping[str, Any]:
    """Return a mapping as its receiver gets it: converted to JSON and back.

    Raises:
        ContractBroken: `value` is no JSON object; `what` begins the message.
    """
    if not isinstance(value, Mapping):
        given = "None" if value is None else repr(value)
        raise ContractBroken(f"{what} {given}; a mapping is required")
    strange = [key for key in value if not isinstance(key, str)]
    if strange:
        raise ContractBroken(f"{what} {value!r}; the key {strange[0]!r} is no text")
    try:
        return dict(json.loads(json.dumps(dict(value), allow_nan=False)))
    except (TypeError, ValueError) as fault:
        raise ContractBroken(f"{what} {value!r}, which is no JSON object: {fault}") from None
