"""Write the table of event kinds into docs/reference/events.md, from `rosrm.model.event_kinds`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from rosrm.model.event_kinds import EventKind

PAGE: Final = Path(__file__).parents[1] / "docs" / "reference" / "events.md"
_HEAD: Final = "| kind | meaning |\n|---|---|\n"


def with_table(page: str) -> str:
    """Return the page with a new table: from the head to the next empty line."""
    before, _, rest = page.partition(_HEAD)
    _, _, after = rest.partition("\n\n")
    rows = "".join(f"| `{kind}` | {kind.meaning} |\n" for kind in EventKind)
    return f"{before}{_HEAD}{rows}\n{after}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
