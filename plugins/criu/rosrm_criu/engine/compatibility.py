"""Compatibility of two hosts for a dump on one and a restore on the other.

Each host reports *facts* about itself: strings by name, as `compatibility_facts` collects them.
Other differences (such as another version of a library) show only when CRIU restores. The restore
then fails, and the source continues to run.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from rosrm.wording import listed

#: The names of the facts, each with its meaning.
FACTS = {
    "version": "of CRIU",
    "kernel": "its release; told, but not compared: CRIU adapts a process to another kernel",
    "machine": "the architecture: x86_64",
    "cpu": "features of the processor that programs use, sorted, a space between them",
    "uid": "of the user that CRIU acts as",
    "all_users": "yes: it may restore processes of every user; no: of its own alone",
    "python": "the Python interpreter that slave and nodes run on: its real path",
    "python_version": "its version",
    "libc": "the C library's version",
}


def mismatch(source: Mapping[str, str], destination: Mapping[str, str]) -> str:
    """Return the reason why an image of one host cannot be restored on another; "": it can.

    Args:
        source: facts of the host that dumps.
        destination: facts of the host that is to restore.
    """
    missing = [name for name in FACTS if name not in source or name not in destination]
    if missing:
        return f"it is not known of both hosts what they have: {', '.join(missing)}"
    if source["machine"] != destination["machine"]:
        return f"its machine is {destination['machine']}, the source's {source['machine']}"
    if _number(destination["version"]) < _number(source["version"]):
        return (
            f"its CRIU {destination['version']} is older than the source's {source['version']}, "
            "whose images it may not understand"
        )
    lacking = sorted({*source["cpu"].split()} - {*destination["cpu"].split()})
    if lacking:
        named = listed(lacking)
        return f"its processor lacks what a program of the source may use already: {named}"
    if destination["all_users"] != "yes" and source["uid"] != destination["uid"]:
        return (
            f"the process belongs to the user {source['uid']}, and its CRIU restores only those of "
            f"the user {destination['uid']}"
        )
    for name, what in (
        ("python", "Python interpreter is"),
        ("python_version", "Python is"),
        ("libc", "C library is"),
    ):
        if source[name] != destination[name]:
            return f"its {what} {destination[name] or 'none'}, the source's {source[name]}"
    return ""


def _number(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)))
