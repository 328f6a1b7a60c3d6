"""Near matches for messages: "did you mean ...?"."""

from __future__ import annotations

from collections.abc import Iterable


def get_close_matches(
    word: str, possibilities: Iterable[str], n: int = 3, cutoff: float = 0.6
) -> list[str]:
    """As `difflib.get_close_matches`, which is imported only when somebody made a mistake."""
    import difflib  # noqa: PLC0415 - the runtimes, whose memory is budgeted, seldom need it

    return difflib.get_close_matches(word, list(possibilities), n=n, cutoff=cutoff)


def counted(number: int, singular: str, plural: str = "") -> str:
    """Return a number with its noun: "1 process", "2 processes"; `plural` if "s" is not enough."""
    return f"{number} {singular if number == 1 else plural or singular + 's'}"
