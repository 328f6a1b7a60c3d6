"""Capabilities of hosts: an executor of the strategy's plugin checks each host.

=============================  ==============================================================
observed                       action
=============================  ==============================================================
a host is up, and unchecked    `RunExecutor` with the strategy's `host_check`
the host has answered          the answer is valid until the host registers again
no answer within 30 s          the order is repeated after 10 s
`host_check` cannot be read    the plugin is called again after 10 s
=============================  ==============================================================

The answers are not persisted. Until a host has answered, no process moves to or from it by that
strategy.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.events import OrderOutcome
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.plugin_failures import why_broken
from rosrm.core.master.state.capabilities import Answer
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.pending_orders import CapabilityQuery
from rosrm.errors import PluginError
from rosrm.extensions.contracts import HostChecking
from rosrm.extensions.plugin_calls import implements, required
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import RunExecutor
from rosrm.wording import listed

#: Seconds for an answer, until an order without an answer is repeated, and until a host is asked
#: again where a strategy did not work.
_PATIENCE: Final = 30.0
_ASK_AGAIN: Final = 10.0
_CHECK_AGAIN: Final = 600.0


def ask_hosts(state: MasterState, now: float) -> None:
    """Order the check of each strategy on every host that is up and has given no valid answer."""
    for name, strategy in state.strategies.items():
        if implements(strategy, HostChecking):
            for host in state.hosts.hosts:
                if state.hosts.condition_of(host) is HostCondition.UP:
                    _ask(state, name, strategy, host, now)


def _ask(state: MasterState, name: str, strategy: HostChecking, host: Host, now: float) -> None:
    known = state.capability_answers.get((name, host.name))
    incarnation = host.description.incarnation
    if known is not None and known.incarnation == incarnation and now < known.ask_at:
        return
    former = known.reason if known is not None and known.incarnation == incarnation else ""
    answer = Answer(incarnation, reason=former, ask_at=now + _ASK_AGAIN)
    state.capability_answers[name, host.name] = answer
    try:
        executor = state.plugins.ask(
            "migration", name, "host_check", lambda: required(strategy.host_check, str), strategy
        )
    except PluginError as error:
        answer.reason = f"its host check is not known: {error}"
        return
    if executor not in host.description.executors:
        # Checked again later, because a slave reports broken plugins only after its registration.
        answer.reason = why_broken(host, name) or f"the plugin of {name!r} is not installed there"
        return
    query = CapabilityQuery(name, host.name)
    answer.order = state.send(host, RunExecutor(executor, timeout=_PATIENCE), query)
    answer.ask_at += _PATIENCE


def note_answer(
    state: MasterState, query: CapabilityQuery, event: happened.OrderAnswered, now: float
) -> None:
    """Note the answer of a host about a strategy; ignore the answer to an earlier order."""
    strategy, host = query.strategy, query.host
    answer = state.capability_answers[strategy, host]
    if answer.order != event.order:
        return
    if event.accepted:
        answer.facts = {key: str(value) for key, value in (event.result or {}).items()}
        answer.reason, answer.ask_at = "", inf
    elif event.outcome is OrderOutcome.TIMEOUT:
        answer.ask_at = now + _ASK_AGAIN
    else:
        former, answer.reason, answer.ask_at = answer.reason, event.reason, now + _CHECK_AGAIN
        if answer.reason != former:
            why = f"{strategy} does not work on {host}: {answer.reason}"
            state.record(
                now, EventKind.STRATEGY_ABSENT, why, host=host, facts={"strategy": strategy}
            )


def are_checked(state: MasterState, strategy: str) -> bool:
    """Return True if a strategy checks between which hosts it can move processes."""
    checking: object = state.strategies.get(strategy)
    return implements(checking, HostChecking)


def fault(state: MasterState, strategy: str, source: Host, destination: Host) -> str:
    """Return why a strategy cannot move anything from one host to another; "" if it can.

    Args:
        strategy: its name; a strategy without a check of the hosts has no fault.
    """
    checking: object = state.strategies.get(strategy)
    if not implements(checking, HostChecking):
        return ""
    facts = []
    for host in (source, destination):
        answer = state.capability_answers.get((strategy, host.name))
        if answer is None or answer.facts is None:
            return _absent(strategy, answer, [host.name])
        facts.append(answer.facts)
    asked = checking
    try:
        return state.plugins.ask(
            "migration", strategy, "host_fault",
            lambda: required(asked.host_fault(*map(dict, facts)), str),  # copies, to change freely
            asked,
        )  # fmt: skip
    except PluginError as error:
        return f"the check of the hosts by {strategy} failed: {error}"


def faults(state: MasterState, strategy: str, source: Host) -> list[str]:
    """Return the reasons why a strategy cannot move anything from a host, each reason once."""
    absent: dict[str, tuple[Answer | None, list[str]]] = {}
    others: dict[str, None] = {}
    answers = state.capability_answers
    here = answers.get((strategy, source.name))
    for host in state.hosts.listed():
        found = "" if host is source else fault(state, strategy, source, host)
        answer = answers.get((strategy, host.name))
        if found and here and here.facts is not None and (answer is None or answer.facts is None):
            absent.setdefault(answer.reason if answer else "", (answer, []))[1].append(host.name)
        elif found:
            others[found] = None
    return [*(_absent(strategy, *alike) for alike in absent.values()), *others]


def _absent(strategy: str, answer: Answer | None, hosts: Sequence[str]) -> str:
    """Return a sentence: the strategy does not work on hosts, or they have not answered yet."""
    if answer is None or not answer.reason:
        return f"it is not known yet whether {strategy} works on {listed(hosts, most=3)}"
    return f"{strategy} does not work on {listed(hosts, most=3)}: {answer.reason}"
