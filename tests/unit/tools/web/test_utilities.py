"""CSS classes of the page."""

from __future__ import annotations

import re
from pathlib import Path

from rosrm_web import page
from rosrm_web.page.utilities import UTILITIES

#: Classes of Quasar, which is loaded.
QUASAR = {"text-h6"}


def test_each_class_of_the_page_has_a_rule():
    """A class of Tailwind without a rule would have no effect, because Tailwind is not loaded."""
    sources = [file.read_text() for file in Path(page.__file__).parent.glob("*.py")]
    used = {name for text in sources for one in re.findall(r'\.classes\("(.*?)"', text)
            for name in one.split()}  # fmt: skip
    known = {*QUASAR, *re.findall(r"^\.([\w-]+) \{", UTILITIES, re.MULTILINE)}

    assert {"w-full", "p-0"} <= used
    assert {name for name in used - known if not name.startswith("rosrm-")} == set()
