"""Compatibility of two hosts for a dump on one and a restore on the other.

Each host reports *facts* about itself: strings by name.
Other differences (such as another version of a library) show only when CRIU restores. The restore
then fails, and the source continues to run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from rosrm.wording import listed
from rosrm_criu.engine.binary import CriuBinary, may_do_all, numbers_in

#: Real path of the running interpreter (`sys.executable` may be a link, or empty).
INTERPRETER: Final = os.path.realpath("/proc/self/exe")

#: The x86 CPU flags that a program may depend on: instructions and registers. Other flags concern
#: only the kernel, or may differ without effect on programs.
_X86: Final = re.compile(
    r"mmx|fxsr|fpu|cx8|cx16|cmov|sse\w*|ssse3|pni|avx\w*|fma\w*|aes|vaes|v?pclmulqdq|popcnt|movbe|"
    r"f16c|bmi[12]|abm|adx|sha_ni|sha512|sm[34]|rdrand|rdseed|rdtscp|xsave\w*|fsgsbase|gfni|"
    r"amx_\w+|erms|fsrm|lahf_lm|clflush|clflushopt|clwb|movdiri|movdir64b|serialize|waitpkg|pku|"
    r"ospke|3dnow\w*|xop|tbm|rtm|hle|user_shstk"
)

#: The names of the facts, each with its meaning.
FACTS: Final = {
    "version": "of CRIU",
    "kernel": "its release; shown, but not compared: CRIU adapts a process to another kernel",
    "machine": "the architecture: x86_64",
    "cpu": "features of the processor that programs use, sorted, a space between them",
    "uid": "of the user that CRIU acts as",
    "all_users": "yes: it may restore processes of every user; no: of its own alone",
    "python": "the Python interpreter that slave and nodes run on: its real path",
    "python_version": "its version",
    "libc": "the C library's version",
}


def facts_of(criu: CriuBinary) -> Mapping[str, str]:
    """Return this host's facts, by the names of `FACTS`."""
    import platform  # noqa: PLC0415 - 0.1 MiB, which a slave without checkpoints does not need

    return {
        "version": criu.version,
        "kernel": platform.release(),
        "machine": platform.machine(),
        "cpu": features(Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")),
        "uid": str(os.geteuid()),
        "all_users": "yes" if may_do_all() else "no",
        "python": INTERPRETER,
        "python_version": platform.python_version(),
        "libc": " ".join(platform.libc_ver()),
    }


def features(cpuinfo: str) -> str:
    """Return the features that all CPUs of a machine have, sorted and separated by spaces.

    Args:
        cpuinfo: content of /proc/cpuinfo: `flags` on x86, `Features` on ARM.
    """
    lines = re.findall(r"^(flags|Features)\s*:(.*)$", cpuinfo, re.MULTILINE)
    common = set.intersection(*(set(words.split()) for _, words in lines)) if lines else set()
    if lines and lines[0][0] == "flags":
        common = {word for word in common if _X86.fullmatch(word)}
    return " ".join(sorted(common))


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
    if numbers_in(destination["version"]) < numbers_in(source["version"]):
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
