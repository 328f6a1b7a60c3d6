"""Split of a command line into words, refused if a shell would do more than split it."""

from __future__ import annotations

import json
import re
from typing import Final, Literal

Role = Literal["program", "argument", "name"]

#: Parts of a text: blanks, an escaped character, quoted text, other characters.
_PART: Final = re.compile(
    r"""(?P<blank>\s+)|\\(?P<escaped>.)|'(?P<single>[^']*)'|"(?P<double>(?:\\.|[^"\\])*)"|"""
    r"""(?P<plain>[^\s'"\\]+)""",
    re.DOTALL,
)
#: What a shell would interpret outside quotes.
_SYNTAX: Final = re.compile(
    r"&&|\|\||>>|<<|[|&;<>`*()]|\$[\w{(\[@#?$!*-]+|(?:(?<=\s)|\A)\#|(?<=\s)~(?!_)|"
    r"\{[^\s{}]*(?:,|\.\.)[^\s{}]*\}"
)
#: What a shell would interpret in double quotes, too.
_EXPANDED: Final = re.compile(r"(?<!\\)(?:\\\\)*(`|\$[\w{(\[@#?$!*-]+)")
#: Option after which a word is a script, as in `bash -c "echo $HOME"`: its shell interprets it.
_SCRIPT: Final = re.compile(r"-[a-z]{0,3}c")
_VARIABLE: Final = re.compile(r"[A-Za-z_]\w*\+?=")
#: First words that are no programs.
_OF_SHELLS: Final = frozenset({
    "!", ".", "[[", "alias", "case", "cd", "eval", "exec", "export", "for", "function", "if", "set",
    "source", "trap", "ulimit", "umask", "unset", "until", "while", "{",
})  # fmt: skip


def shell_words(text: str, role: Role) -> tuple[str, ...]:
    """Return the words of a text.

    `role`: of its first word; the other words of a program are arguments.

    Raises:
        ValueError: a quotation is not closed, or a shell would do more than split the text.
    """
    text = text.strip()
    words: list[str] = []
    doubled: list[str] = []
    outside, at, is_open = "", 0, False
    while at < len(text):
        part = _PART.match(text, at)
        if part is None:
            why = "ends with a backslash" if text[at] == "\\" else f"has no closing {text[at]}"
            raise ValueError(f"{text!r} cannot be split into words: it {why}")
        kind, at = str(part.lastgroup), part.end()
        found = part[kind]
        outside += part[0] if kind in ("plain", "blank") else "_" * len(part[0])
        if kind == "double":
            doubled.append(found)
            found = re.sub(r'\\([$`"\\])', r"\1", found)
        if kind != "blank":
            words.append(words.pop() + found if is_open else found)
        is_open = kind != "blank"
        if (kind in ("blank", "escaped") and "\n" in found) or (
            kind == "double" and "\\\n" in found
        ):
            raise ValueError(
                f"{text!r} has several lines, but a command has one. Write it on one line or as a "
                f"list of words, or {_in_a_shell(text)}"
            )
    found, advice = _syntax(outside, doubled, words, role)
    if found:
        raise ValueError(f"{text!r} {found}. Write {_in_a_shell(text)}{advice}")
    return tuple(words)


def _syntax(outside: str, doubled: list[str], words: list[str], role: Role) -> tuple[str, str]:
    """Return what only a shell would do with a text, and another remedy; "": nothing.

    Args:
        outside: the text with `_` in place of all that is quoted.
        doubled: the parts in double quotes.
    """
    if role == "program" and (variable := _VARIABLE.match(outside)):
        begins = f"begins with {variable[0]!r}, which sets a variable only in a shell"
        return begins, ", or give the variable under `environment`"
    if role == "program" and words and words[0] in _OF_SHELLS:
        return f"begins with {words[0]!r}, which is a shell command, not a program", ""
    # The host replaces a `~` before a program, and rosrm one before a file.
    if found := _SYNTAX.search(f" {outside}" if role == "argument" else outside):
        remedy = f", or quote {found[0]!r} to pass it to the program as it is"
        return f"has {found[0]!r} outside quotes, and no shell reads it", remedy
    for part in () if any(map(_SCRIPT.fullmatch, words)) else doubled:
        if found := _EXPANDED.search(part):
            where = f"has {found[1]!r} in double quotes, where a shell would replace it"
            return where, ", or use single quotes to pass it to the program as it is"
    return "", ""


def _in_a_shell(text: str) -> str:
    return f"[bash, -c, {json.dumps(text, ensure_ascii=False)}] for a shell"
