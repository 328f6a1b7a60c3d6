"""Words of a command line, beside those of a real shell."""

from __future__ import annotations

import subprocess
from contextlib import suppress

from hypothesis import example, given, settings
from hypothesis import strategies as st

from rosrm.config.shell_words import shell_words

TEXTS = st.text(st.sampled_from("ab=~#$*?[]{},.'\"\\ \n\t()`!&;<>|/é1-"), max_size=12)


@settings(deadline=None, max_examples=400)
@given(texts=st.lists(TEXTS, min_size=20, max_size=20))
@example(texts=['"\\$a"', '"\\a"', "a\\ b", "'a'\"b\"c", "a#b", "''", "{a}", "a~ ~b"])
@example(texts=["~-", "~+", "~1", "~root", "~'root'"])
def test_words_that_are_accepted_are_those_of_a_shell(texts):
    """The rest is refused, so no program gets other words than the user means."""
    accepted = []
    for text in texts:
        with suppress(ValueError):
            accepted.append((text, shell_words(f"p {text}", "program")))
    script = "".join(f"p {text.strip()}\n" for text, _ in accepted)
    prints = "set -f; p() { printf '%s\\0' p \"$@\"; printf END; }\n"
    ran = subprocess.run(
        ["bash", "-c", prints + script], capture_output=True, check=True, encoding="utf-8"
    )
    expected = "".join("".join(f"{word}\0" for word in words) + "END" for _, words in accepted)
    assert (ran.stdout, ran.stderr) == (expected, "")
