"""Output of `rosrm explain`: the placement of a process, host by host."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.text import Text

from rosrm.cli.output import tables
from rosrm.wording import amount, by_reason, counted, duration, listed, size, words

#: Wording of each decision of the master about a process.
_DECIDED: Final = {
    "assigned": "The master assigned {process} to {host}{ago}",
    "migrated": "The master chose {host} as the destination of a move of {process}{ago}",
    "stayed": "The master chose {host} as the destination of a move{ago}, and the move was undone",
    "waits": "No host can take {process} now",
    "fits": "{host} could take {process} now",
    "set_aside": "No host may take {process}",
}
_STYLES: Final = {"chosen": "green", "vetoed": "yellow", "excluded": "red", "full": "yellow"}
#: Decimals of a score; further ones are rounding errors of a sum, such as 1.4e-17.
_DECIMALS: Final = 9
#: Most flows of a process that are shown.
_MOST_FLOWS: Final = 8
_UNITS: Final = {"memory": "B", "disk": "B", "cpu": "core"}


def render(explanation: Mapping[str, Any]) -> RenderableType:
    """Return the master's explanation of one process for a rich console."""
    return Group(*_parts(explanation))


def _parts(explanation: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield headline(explanation)
    if explanation.get("flows"):
        yield _flows(explanation["flows"], explanation.get("flows_omitted", 0))
    if explanation.get("kept"):
        yield _replicas(explanation["kept"])
    if explanation.get("checkpoint"):
        yield _checkpoint(explanation["checkpoint"])
    if explanation.get("limits"):
        yield _limits(explanation["limits"])
    decision = explanation.get("decision")
    if decision:
        yield Text()
        yield sentence(explanation["process"], decision)
        yield needs(decision.get("need") or {})
        if decision.get("hosts"):
            yield _hosts(decision)
        for reason, count in (decision.get("omitted") or {}).items():
            if count:
                yield Text(f"and {counted(count, 'more host')} {reason}", "dim")
    if explanation.get("defaults"):
        yield Text()
        yield _defaults(explanation["defaults"])
    history = explanation.get("history") or ()
    yield Text()
    if not history or history[0]["kind"] != "submitted":
        name = explanation["process"]
        yield Text(f"Older events are left out: `rosrm events --process {name}`", "dim")
    for entry in history:
        ago = f"{duration(entry['elapsed'])} ago"
        yield tables.entry(f"{ago:>14}", entry["kind"], entry["message"])


def headline(explanation: Mapping[str, Any]) -> Text:
    """Return state, host, reason and owner of a process."""
    text = tables.sentence(explanation["process"], explanation["state"])
    if explanation.get("host"):
        text.append(f" on {explanation['host']}")
    reason = "; ".join(filter(None, (explanation.get("reason"), explanation.get("advice"))))
    if reason:
        text.append(f": {reason}")
    if explanation.get("owner"):
        text.append(f"\nOwner: {explanation['owner']}")
    return text


def _flows(flows: list[Mapping[str, Any]], omitted: int) -> Text:
    """Return the flows from and to other processes, and why some of them do not count yet.

    Args:
        flows: the largest first.
        omitted: number of smaller flows.
    """
    lines = []
    for one in flows[:_MOST_FLOWS]:
        where = f" on {one['host']}" if one["host"] else ""
        text = (
            f"{amount(one['rate'], 'B/s')} {'from' if one['incoming'] else 'to'} "
            f"{one['process']}{where} ({'measured' if one['learned'] else 'declared'})"
        )
        if one.get("round_trip") is not None:
            text += f", round trip {one['round_trip'] * 1e3:.3g} ms"
        if one.get("link_rate") is not None:
            text += f", link {amount(one['link_rate'], 'B/s')}"
        if not one["host"]:
            text += f" does not count yet: {one['process']} {one['reason']}"
        lines.append(text)
    others = len(flows) - len(lines) + omitted
    if others:
        lines.append(f"and {counted(others, 'smaller flow')}")
    return Text(f"Flows: {lines[0]}." if len(lines) == 1 else "\n  ".join(["Flows:", *lines]))


def _replicas(replicas: list[Mapping[str, Any]]) -> Text:
    """Return the hosts with a replica of the snapshot, and the cycle of each."""
    places = [
        f"{one['host']} (cycle {one['sequence']}, {size(one['size'])}, "
        f"{duration(one['elapsed'])} ago)"
        for one in replicas
    ]
    return Text(f"Snapshots of its state are on {listed(places)}.")


def _checkpoint(checkpoint: Mapping[str, Any]) -> Text:
    """Return the newest periodic checkpoint, and the failure of the next one, if any."""
    if checkpoint["elapsed"] is None:
        text = "No periodic checkpoint of its memory exists yet"
    else:
        text = (
            f"The last periodic checkpoint is {duration(checkpoint['elapsed'])} old "
            f"({size(checkpoint['size'])}; the process was paused for {checkpoint['pause']:.1f} s)"
        )
    return Text(f"{text}: {checkpoint['trouble']}" if checkpoint["trouble"] else f"{text}.")


def _limits(limits: Mapping[str, Mapping[str, Any]]) -> Text:
    """Return limits and scheduling, and those that do not hold in this run with the reasons."""
    values = ", ".join(
        f"{name} {one['value']}"
        + (f" (earlier runs of its program used {one['used']})" if "used" in one else "")
        for name, one in limits.items()
    )
    unmet = [(name, one["reason"]) for name, one in limits.items() if not one.get("holds", True)]
    if not unmet:
        holds = " The host enforces them." if any("holds" in one for one in limits.values()) else ""
        return Text(f"Limits and scheduling: {values}.{holds}")
    reasons = by_reason((name, reason or "see above") for name, reason in unmet)
    return Text(f"Limits and scheduling: {values}. ").append(f"Not enforced: {reasons}.", "yellow")


def sentence(name: str, decision: Mapping[str, Any]) -> Text:
    """Return the decision of the master about a process."""
    ago = f" {duration(decision['elapsed'])} ago" if decision.get("elapsed") else ""
    form = _DECIDED.get(decision["kind"], "{process}: " + words(decision["kind"]))
    what = form.format(process=name, host=decision.get("chosen"), ago=ago)
    return Text(f"{what}. Scoring policy: {decision['policy'] or 'none'}; the lowest score wins.")


def needs(need: Mapping[str, float]) -> Text:
    """Return the amounts of resources that a process needs."""
    amounts = [f"{name} {amount(value, _UNITS.get(name, ''))}" for name, value in need.items()]
    return Text(f"Needs, declared or estimated: {', '.join(amounts) or 'none'}.")


def _defaults(defaults: Mapping[str, Any]) -> Text:
    """Return the fields whose values are the cluster's, without values that may be secret."""
    fields = [
        path if value is None else f"{path} {json.dumps(value)}" for path, value in defaults.items()
    ]
    return Text(f"From `defaults.process` of the cluster: {', '.join(fields)}.")


def _hosts(decision: Mapping[str, Any]) -> RenderableType:
    made = tables.table("HOST", "", "SCORE", "WHY", right=("SCORE",))
    for name, verdict, score, reason in host_cells(decision):
        made.add_row(Text(name), Text(verdict, _STYLES.get(verdict, "")), score, Text(reason))
    return made


def host_cells(decision: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, verdict, score and reason of each host of a decision."""
    for host in decision.get("hosts") or ():
        score = host.get("score")
        yield (
            host["name"],
            host["verdict"] if decision["kind"] != "fits" else "fits",
            "" if score is None else f"{round(score, _DECIMALS) + 0.0:.4g}",
            host.get("reason") or "",
        )
