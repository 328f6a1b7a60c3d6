"""Kept plans of `apply`, `revert` and `mode`: their requests, compared with plan and result."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from rosrm.cli.output.plain import echo
from rosrm.errors import ConfigError, Refused
from rosrm.model.applications import Action, ApplyResult, PlannedAction
from rosrm.model.codec import from_plain
from rosrm.model.rows import ProcessRow
from rosrm.wording import few, listed, reason_of


class Request(Protocol):
    """A request on applications with its arguments, such as the desired targets."""

    def __call__(self, *, plan_only: bool = False) -> ApplyResult:
        """Make the request, or return its plan."""


def read_plan(path: str) -> ApplyResult | None:
    """Return the plan that a command with `--plan --json` has printed into a file.

    `path`: "": there is none.
    """
    if not path:
        return None
    try:
        return from_plain(ApplyResult, json.loads(Path(path).read_bytes()))
    except OSError as fault:
        why = reason_of(fault)
    except (UnicodeDecodeError, json.JSONDecodeError):
        why = "the file is not JSON"
    except (KeyError, TypeError, ValueError) as fault:
        why = str(fault)
    raise ConfigError(
        f"--as-planned: {path}: {why}; the same command with `--plan --json > FILE` writes a plan"
    )


def _print_warning(text: str) -> None:
    echo(f"rosrm: {text}", err=True)


def as_planned(
    planned: ApplyResult | None, request: Request, warn: Callable[[str], None] = _print_warning
) -> Request:
    """Return a request that is only made if a kept plan of it still holds.

    It returns the actions with the hosts planned now.

    Args:
        planned: the kept plan; None: there is none.
        request: the request without a condition.
        warn: called with a phrase on each difference that stems from other readings.
    """
    if planned is None:
        return request

    def checked(*, plan_only: bool = False) -> ApplyResult:
        now = request(plan_only=True)
        for text in differences(planned, now):
            warn(f"other readings than at the time of the plan: {text}")
        if plan_only:
            return now
        done = request()
        numbers = done.versions
        actions = [replace(one, version=numbers.get(one.application, 0)) for one in now.actions]
        return replace(done, actions=tuple(actions))

    return checked


def differences(planned: ApplyResult, now: ApplyResult) -> list[str]:
    """Return the differences of two plans that only stem from readings.

    Raises:
        Refused: the work differs, or what is to be done with a process of it.
    """
    if planned.mode != now.mode:
        raise Refused(
            f"the plan is one of {_subject(planned)}, and the request is one of {_subject(now)}. "
            f"Nothing was changed"
        )
    if planned.work != now.work:
        raise Refused("the work differs from that of the plan; plan again. Nothing was changed")
    others = _compared(planned.actions, now.actions, _what)
    if others:
        raise Refused(
            f"other actions are needed now than at the time of the plan: {'; '.join(few(others))}. "
            f"Plan again. Nothing was changed"
        )
    return _compared(planned.actions, now.actions, _text)


def _subject(plan: ApplyResult) -> str:
    return f"the mode {plan.mode}" if plan.mode else "applications"


def elsewhere(actions: Iterable[PlannedAction], rows: Iterable[ProcessRow]) -> list[str]:
    """Return a sentence on each process that is on another host than planned."""
    hosts = {row.name: row.host for row in rows}
    return [
        f"{one.process} is on {hosts[one.process]}; {one.host} was planned"
        for one in actions
        if one.host and hosts.get(one.process, one.host) not in {"", one.host}
    ]


def _compared(
    planned: Iterable[PlannedAction], now: Iterable[PlannedAction],
    described: Callable[[PlannedAction], str],
) -> list[str]:  # fmt: skip
    before = {one.process: text for one in planned if (text := described(one))}
    after = {one.process: text for one in now if (text := described(one))}
    return [
        f"{name}: {before.get(name, 'no action')} was planned, now {after.get(name, 'no action')}"
        for name in before | after
        if before.get(name) != after.get(name)
    ]


def _what(action: PlannedAction) -> str:
    """Return an action without its hosts; "" for a move, which readings decide."""
    if action.action is Action.MOVE:
        return ""
    changed = f" (changed: {listed(action.fields)})" if action.fields else ""
    return f"{action.action.value}{changed}"


def _text(action: PlannedAction) -> str:
    moves = action.before and action.host and action.before != action.host
    there = f"from {action.before} to {action.host}" if moves else action.host or action.before
    where = f"{'' if moves else ' on'} {there}" if there else ""
    return f"{action.action.value}{where}{', and a wait' if action.waits else ''}"
