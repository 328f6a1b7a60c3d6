"""Phrases for messages: near matches ("did you mean ...?"), plurals, states, amounts with units."""

from __future__ import annotations

import math
import re
import signal
import time
from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Final

_SIZES: Final = ("B", "kB", "MB", "GB", "TB", "PB")
_BINARY_SIZES: Final = ("B", "KiB", "MiB", "GiB", "TiB", "PiB")
#: Highest number of names with which a misspelt name is compared, because the master's loop waits.
MOST_COMPARED: Final = 1000
#: Commands that list the names of a kind.
_LISTED_BY: Final = {
    "process": "rosrm ps --all", "host": "rosrm hosts", "array": "rosrm ps --all --json",
    "application": "rosrm apps", "mode": "rosrm mode",
}  # fmt: skip
_STANDING: Final = {
    "backoff": "is in back-off",
    "failed": "has failed",
    "finished": "has finished",
    "cancelled": "was cancelled",
}


#: Control characters of ASCII and ISO 8859-1 (C0, DEL, C1), except newline and tab.
_CONTROLS: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    """Return text for a terminal or log, with each control character but newline as its number.

    Terminals execute such characters: they rename windows, hide lines, or answer as a keyboard.
    """
    return _CONTROLS.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


def get_close_matches(
    word: str, possibilities: Iterable[str], n: int = 3, cutoff: float = 0.6
) -> list[str]:
    """Return the names most similar to a misspelt one, as `difflib.get_close_matches`."""
    import difflib  # noqa: PLC0415 - the runtimes, whose memory is budgeted, seldom need it

    return difflib.get_close_matches(word, list(possibilities), n=n, cutoff=cutoff)


def no_such(kind: str, names: Sequence[str], known: Iterable[str]) -> str:
    """Return the refusal of unknown names, with the nearest known names or some of the known ones.

    Args:
        kind: key of `_LISTED_BY`.
        names: unknown names.
        known: known names of that kind; those after the first `MOST_COMPARED` are not compared.
    """
    there = list(islice(known, MOST_COMPARED))
    most = 3 if len(names) == 1 else 1
    near = [repr(one) for name in names[:3] for one in get_close_matches(name, there, most)]
    if near:
        hint = f"did you mean {listed(dict.fromkeys(near), 'or')}?"
    else:
        hint = f"there are: {', '.join(few(there)) or 'none'}"
    unknown = listed(map(repr, names))
    return f"no such {kind}: {unknown}; {hint} (`{_LISTED_BY[kind]}` lists them)"


def counted(number: int, singular: str, plural: str = "") -> str:
    """Return a number with its noun: "no processes", "1 process", "2 processes".

    Args:
        number: 0 is spelt out.
        singular: noun of 1.
        plural: noun of any other number; "": the singular with an s.
    """
    return f"{number or 'no'} {singular if number == 1 else plural or singular + 's'}"


def with_article(noun: str) -> str:
    """Return a noun with its article: "a host", "an application"."""
    return f"{'an' if noun[:1] in 'aeiou' else 'a'} {noun}"


def few(names: Iterable[str], most: int = 8) -> list[str]:
    """Return at most `most` names; the last item counts the others: "3 more"."""
    first = list(names)
    left_out = len(first) - most + 1
    return first if left_out < 2 else [*first[: most - 1], f"{left_out} more"]


def listed(names: Iterable[str], word: str = "and", most: int = 8) -> str:
    """Return `few` names as an enumeration: "none", "a", "a, b and c"."""
    *first, last = few(names, most) or ["none"]
    return f"{', '.join(first)} {word} {last}" if first else last


def by_reason(reasons: Iterable[tuple[str, str]]) -> str:
    """Return names with their reasons, equal ones once: "each of a and b is lost; c: no room".

    Args:
        reasons: name and its reason; "it" at the beginning of a reason stands for the name.
    """
    names: dict[str, list[str]] = {}
    for name, reason in reasons:
        names.setdefault(reason, []).append(name)
    return "; ".join(_of_all(alike, reason) for reason, alike in names.items())


def _of_all(names: Sequence[str], reason: str) -> str:
    if not reason.startswith("it "):
        return f"{listed(names, most=3)}: {reason}"
    return f"{each_of(names, most=3)} {reason.removeprefix('it ')}"


def each_of(names: Sequence[str], most: int = 8) -> str:
    """Return names as the subject of one predicate: "a", "each of a and b"."""
    return names[0] if len(names) == 1 else f"each of {listed(names, most=most)}"


def first_line(reason: str) -> str:
    """Return a reason without the details in its further lines."""
    return reason.partition("\n")[0]


def one_line(reason: str) -> str:
    """Return a reason and its details, which are in further lines, as one line."""
    return reason.replace("\n", "; ")


def reason_of(error: BaseException) -> str:
    """Return the reason of an error without its number and path: "No space left on device".

    An `OSError` that was made of a text alone, such as a time-out, has no `strerror`.
    """
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def sendable(text: str) -> str:
    """Return a text with "?" for each character without a UTF-8 form, as in a path of other bytes.

    ROS messages hold UTF-8 alone.
    """
    return text.encode(errors="replace").decode()


def sanitized(text: str, most: int = 4096, *, lines: bool = False) -> str:
    """Return a sender's text as one line of bounded length, without unprintable characters.

    Args:
        text: by any sender.
        most: letters.
        lines: True: newlines stay.
    """
    cut = text if len(text) <= most else f"{text[: most - 1]}…"
    if cut.isprintable():
        return cut
    return "".join(
        one if one.isprintable() or (lines and one == "\n") else " " if one.isspace() else "?"
        for one in cut
    )


def signal_name(number: int) -> str:
    """Return the name of a signal: "SIGTERM" for 15, "signal 35" for a real-time signal."""
    try:
        return signal.Signals(number).name  # noqa: TID251 - the one place
    except ValueError:
        return f"signal {number}"


def ending_of(code: int) -> str:
    """Return how a program has ended: "exit code 3", "killed by SIGTERM".

    Args:
        code: its return code; a signal as a negative number.
    """
    return f"exit code {code}" if code >= 0 else f"killed by {signal_name(-code)}"


def words(name: str) -> str:
    """Return the name of a state or kind without underscores."""
    return name.replace("_", " ")


def standing(state: str) -> str:
    """Return the state of a process as a predicate: "is in back-off", "has failed"."""
    return _STANDING.get(state, f"is {words(state)}")


def standing_for(state: str, span: str) -> str:
    """Return a state and its duration: "has been unreachable for 2 min", "finished 2 min ago"."""
    verb, _, rest = standing(state).partition(" ")
    if verb == "is":
        return f"has been {rest} for {span}"
    return f"{rest if verb == 'has' else f'{verb} {rest}'} {span} ago"


def size(amount: float, *, binary: bool = False) -> str:
    """Return bytes with a unit: "512 B", "64.1 MB"; in powers of 1024 "61.1 MiB"."""
    units, factor = (_BINARY_SIZES, 1024.0) if binary else (_SIZES, 1000.0)
    exponent = 0
    while abs(amount) >= factor - 0.5 and exponent < len(units) - 1:
        amount, exponent = amount / factor, exponent + 1
    digits = 0 if exponent == 0 or abs(amount) >= 99.5 else 1
    return f"{amount:.{digits}f} {units[exponent]}"


def percent(fraction: float) -> str:
    """Return a fraction in whole percent without the sign; "?" if it is unknown."""
    return f"{fraction * 100:.0f}" if math.isfinite(fraction) else "?"


def amount(value: float, unit: str) -> str:
    """Return an amount of a resource, given in its base unit."""
    if not math.isfinite(value):
        return "?"
    if unit in ("B", "B/s"):
        return size(value) + unit[1:]
    if unit == "core" and 0.0 < value < 0.001:
        return "under 0.001 cores"
    return f"{value:.3g}" + {"core": " cores", "1": "", "": ""}.get(unit, f" {unit}")


def duration(seconds: float) -> str:
    """Return a span of time in at most two units: "0.4 s", "3 min", "2 h 5 min"."""
    if not math.isfinite(seconds):
        return "?"
    if seconds < 9.95:
        return f"{max(seconds, 0.0):.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = int(seconds // 60)
    if minutes < 120:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours < 48 else f"{hours // 24} d"


def local_time(when: float) -> str:
    """Return a unix time as date and time in this machine's time zone."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(when))


def reload_summary(changed: Sequence[str], kept: Sequence[str]) -> str:
    """Return a predicate on a reload: the changed settings, and those that need a restart."""
    done = f"reloaded {listed(changed)}" if changed else "no setting to reload has changed"
    one = len(kept) == 1
    end = "needs a restart, and stays as before" if one else "need a restart, and stay as before"
    return f"{done}; {listed(kept)} {end}" if kept else done


def weighted(name: str, weight: float) -> str:
    """Return a term of a weighted sum: `0.5 x network`; without a weight of 1."""
    return name if weight == 1.0 else f"{weight:g} x {name}"
