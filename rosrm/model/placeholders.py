"""Placeholders in the texts of a process, which the host that runs the process replaces."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Final

from rosrm.wording import get_close_matches

#: Fields of a process in which placeholders stand.
WITH_PLACEHOLDERS: Final = (
    "command", "prefix", "arguments", "parameters", "parameter_sources", "environment",
    "working_directory", "components",
)  # fmt: skip
#: Name of the directory with the artifacts of the process.
ARTIFACTS: Final = "artifacts"
#: Beginning of the name of a device: `device.camera`.
DEVICE: Final = "device."
#: A placeholder with its name in a group.
PLACEHOLDER: Final = re.compile(r"\{(artifacts|device\.[^{}]*|env\.[A-Za-z_]\w*)\}")
#: Value of a variable on the host, in a variable of the process.
_OF_HOST: Final = re.compile(r"(:?)\{env\.([A-Za-z_]\w*)\}(:?)")
#: What a shell would replace by the value of a variable.
_IN_SHELL: Final = re.compile(r"\$(?:([A-Za-z_]\w*)|\{([A-Za-z_]\w*)\})")

#: A text in braces that may be a misspelt placeholder.
_IN_BRACES: Final = re.compile(r"\{([A-Za-z_]+)((?:[./][^{}]*)?)\}")
#: Similarity from which a word counts as misspelt.
_MISSPELT: Final = 0.75


def extended(text: str, variables: Mapping[str, str]) -> str:
    """Return a variable with the values of the host's variables, as in `/x:{env.PYTHONPATH}`.

    If a variable is not set, no `:` remains at an end, where it would mean the current directory.
    """

    def value(found: re.Match[str]) -> str:
        before, name, after = found.groups()
        known = variables.get(name, "")
        return f"{before}{known}{after}" if known else before and after

    return _OF_HOST.sub(value, text)


def has_variable(text: str) -> bool:
    """Return True if a text has the value of a variable of the host."""
    return _OF_HOST.search(text) is not None


def variable_fault(text: str) -> str:
    """Return why a variable would not have the value that a user means; "": it has."""
    found = _IN_SHELL.search(text)
    if found is None:
        return ""
    name = found[1] or found[2]
    return (
        f"{found[0]} is not replaced, because no shell reads it. Write {{env.{name}}} for the "
        f"value of {name} on the host; `prefix: [env, 'NAME={found[0]}']` passes the text as it is"
    )


def placeholder_faults(text: str, known: Collection[str]) -> Iterator[str]:
    """Yield a sentence on each placeholder in a text that no host can replace.

    Otherwise the program would get the placeholder itself.

    Args:
        known: names of the placeholders of the process, such as "artifacts" and "device.camera".
    """
    for word, rest in _IN_BRACES.findall(text):
        name = f"{word}{rest}"
        if name in known or not _is_meant(word, rest):
            continue
        kind = name.removeprefix(DEVICE)
        if name == ARTIFACTS:
            yield "{artifacts} needs `artifacts:` in the process"
            continue
        close = get_close_matches(name, [*known, ARTIFACTS], 1)
        meant = f"; did you mean {{{close[0]}}}?" if close else ""
        if kind != name:
            asked = [one.removeprefix(DEVICE) for one in known if one.startswith(DEVICE)]
            yield (
                f"{{{name}}} needs a device of the kind {kind!r}, which the process does not ask "
                f"for; its `devices:` are {', '.join(asked) or 'none'}{meant}"
            )
        else:
            yield (
                f"{{{name}}} is unknown{meant or '.'} Allowed: {{artifacts}} with `artifacts:` in "
                "the process, and {device.KIND} with `devices:`"
            )


def _is_meant(word: str, rest: str) -> bool:
    """Return True if a text in braces is a placeholder, or a misspelt one."""
    stems = [ARTIFACTS, DEVICE.rstrip(".")] if rest.startswith(".") else [ARTIFACTS]
    return bool(get_close_matches(word, stems, 1, _MISSPELT))
