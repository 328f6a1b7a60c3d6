"""Summary of the jobs of an array."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from rosrm.cli.output.tables import why
from rosrm.model.rows import ProcessRow
from rosrm.wording import by_reason, words


def summary(rows: Sequence[ProcessRow]) -> str:
    """Return the states of an array's jobs: `3: 2 finished, 1 failed (render-17: exit code 2)`."""
    states = Counter(row.state for row in rows).most_common()
    failed = by_reason((row.name, why(row)) for row in rows if row.state == "failed")
    parts = [
        f"{number} {words(state)}" + (f" ({failed})" if state == "failed" else "")
        for state, number in states
    ]
    return f"{len(rows)}: {', '.join(parts) or 'none on this host'}"


def form(name: str, rows: Sequence[ProcessRow], forms: Sequence[Any]) -> dict[str, Any]:
    """Return the jobs of an array as an object of `--json`; `forms`: the rows as objects."""
    return {
        "array": name,
        "summary": summary(rows),
        "states": Counter(row.state for row in rows),
        "processes": forms,
    }
