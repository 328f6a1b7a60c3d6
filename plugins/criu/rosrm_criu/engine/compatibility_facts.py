"""Facts of a host that decide where its images can be restored."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from rosrm_criu.engine.binary import Criu, may_do_all

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


def facts_of(criu: Criu) -> Mapping[str, str]:
    """Return this host's facts, by the names of `rosrm_criu.engine.compatibility.FACTS`."""
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
