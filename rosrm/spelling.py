"""Near matches for messages: "did you mean ...?"."""

from __future__ import annotations

from collections.abc import Iterable


def get_close_matches(
    word: str, possibilities: Iterable[str], n: int = 3, cutoff: float = 0.6
) -> list[str]:
    """As `difflib.get_close_matches`, which is imported only when somebody made a mistake."""
    import difflib  # noqa: PLC0415 - the runtimes, whose memory is budgeted, seldom need it

    return difflib.get_close_matches(word, list(possibilities), n=n, cutoff=cutoff)
