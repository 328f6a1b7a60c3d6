"""`rosrm explain`: why a process is where it is, host by host."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.text import Text

from rosrm.cli import formats, tables

_SAID: Final = {
    "assigned": "was given to",
    "migrated": "was moved to",
    "stayed": "was to move to",
    "waits": "waits",
    "set_aside": "is set aside",
}
_STYLES: Final = {"chosen": "green", "vetoed": "yellow", "excluded": "red", "full": "yellow"}
_UNITS: Final = {"memory": "B", "disk": "B", "cpu": "core"}


def render(story: Mapping[str, Any]) -> RenderableType:
    """The master's explanation of one process."""
    return Group(*_parts(story))


def _parts(story: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield _headline(story)
    if story.get("kept"):
        yield _kept(story["kept"])
    if story.get("checkpoint"):
        yield _checkpoint(story["checkpoint"])
    decision = story.get("decision")
    if decision:
        yield Text()
        yield _sentence(decision)
        yield _needs(decision.get("need") or {})
        if decision.get("hosts"):
            yield _hosts(decision["hosts"])
        for reason, count in (decision.get("omitted") or {}).items():
            if count:
                yield Text(f"and {count} more: {reason}", "dim")
    history = story.get("history") or ()
    if history:
        yield Text()
        for entry in history:
            ago = f"{formats.duration(entry['elapsed'])} ago"
            yield Text(f"{ago:>14}  {formats.words(entry['kind']):<18} {entry['message']}")


def _headline(story: Mapping[str, Any]) -> Text:
    text = Text(f"{story['process']} is ")
    text.append_text(tables.state(story["state"]))
    if story.get("host"):
        text.append(f" on {story['host']}")
    if story.get("reason"):
        text.append(f": {story['reason']}")
    return text


def _kept(kept: list[Mapping[str, Any]]) -> Text:
    """Where its state is kept, and how far it is."""
    places = [
        f"{one['host']} (cycle {one['sequence']}, {formats.size(one['size'])}, "
        f"{formats.duration(one['elapsed'])} ago)"
        for one in kept
    ]
    return Text(f"Its state is kept on {', '.join(places)}.")


def _checkpoint(told: Mapping[str, Any]) -> Text:
    """The newest periodic checkpoint, and what is wrong with the next."""
    if told["elapsed"] is None:
        text = "There is no checkpoint of its memory yet"
    else:
        text = (
            f"The last checkpoint of its memory was made {formats.duration(told['elapsed'])} ago "
            f"({formats.size(told['size'])}, away for {told['pause']:.1f} s)"
        )
    return Text(f"{text}: {told['trouble']}" if told["trouble"] else f"{text}.")


def _sentence(decision: Mapping[str, Any]) -> Text:
    said = _SAID.get(decision["kind"], formats.words(decision["kind"]))
    where = f" {decision['chosen']}" if decision.get("chosen") else ""
    ago = f", {formats.duration(decision['elapsed'])} ago" if decision.get("elapsed") else ""
    return Text(f"It {said}{where}{ago} (scoring policy {decision['policy']}; the lowest wins).")


def _needs(need: Mapping[str, float]) -> Text:
    amounts = [
        f"{name} {formats.amount(value, _UNITS.get(name, ''))}" for name, value in need.items()
    ]
    return Text(f"Counted for it: {', '.join(amounts) or 'nothing'}.")


def _hosts(hosts: list[Mapping[str, Any]]) -> RenderableType:
    made = tables.table("HOST", "", "SCORE", "WHY", right=("SCORE",))
    for host in hosts:
        score = host.get("score")
        verdict = host["verdict"]
        made.add_row(
            Text(host["name"]),
            Text(verdict, _STYLES.get(verdict, "")),
            "" if score is None else f"{score:.4g}",
            Text(host.get("reason") or ""),
        )
    return made
