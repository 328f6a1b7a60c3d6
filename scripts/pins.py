"""Resolve every distribution with all its extras and pins on each supported Python: `make pins`.

A micro version matters: a package may require one that is newer than that of a distribution of
Linux. A success is recorded in `constraints.txt`; a test compares the record with the pins and the
requirements, so that no change of either is committed unresolved.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tomli
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = ROOT / "constraints.txt"
PROJECTS = [
    path.relative_to(ROOT)
    for folder in (".", "rosrm_msgs", "composition_interfaces", "examples", "plugins/*", "tools/*")
    for path in sorted(ROOT.glob(f"{folder}/pyproject.toml"))
]

#: The oldest Python that the README promises of each minor version, and who ships it.
PYTHONS = {
    "3.10.12": "Ubuntu 22.04",
    "3.11.2": "Debian 12",
    "3.12.3": "Ubuntu 24.04",
    "3.13.5": "Debian 13",
}
#: The only package that has no wheel: a pure Python one.
FROM_SOURCE = "empy"
RECORD = re.compile(r"^# Resolved for Python .*: (?P<digest>\w+)\n", re.MULTILINE)


def read(project: Path) -> dict[str, Any]:
    """Return the content of a `pyproject.toml`, given relative to the repository."""
    return tomli.loads((ROOT / project).read_text())


OWN = {canonicalize_name(read(project)["project"]["name"]) for project in PROJECTS}


def requirements(project: Path) -> Iterator[Requirement]:
    """Yield what a distribution requires for its build, for use and for each extra."""
    settings = read(project)
    lines = [*settings["build-system"]["requires"], *settings["project"].get("dependencies", ())]
    for extra in settings["project"].get("optional-dependencies", {}).values():
        lines += extra
    yield from map(Requirement, lines)


def foreign_requirements() -> list[str]:
    """Return all requirements that other projects satisfy."""
    found = {one for project in PROJECTS for one in requirements(project)}
    return sorted(str(one) for one in found if canonicalize_name(one.name) not in OWN)


def pin_lines() -> list[str]:
    """Return the lines of `constraints.txt` without comments."""
    lines = (line.partition("#")[0].strip() for line in CONSTRAINTS.read_text().splitlines())
    return [line for line in lines if line]


def digest() -> str:
    """Return a digest of all that a resolution depends on in this repository."""
    text = "\n".join([*PYTHONS, *pin_lines(), *foreign_requirements()])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def recorded() -> str:
    """Return the digest of the last successful resolution; empty: none."""
    match = RECORD.search(CONSTRAINTS.read_text())
    return match["digest"] if match else ""


def faults(python: str) -> str:
    """Resolve everything for one Python; return why that is impossible, or an empty text."""
    with tempfile.TemporaryDirectory() as folder:
        wanted = Path(folder, "requirements.in")
        wanted.write_text("\n".join(foreign_requirements()) + "\n")
        done = subprocess.run(
            [
                *(sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--no-header"),
                *("--no-config", "--no-annotate", "--python-version", python),
                *("--python-platform", "x86_64-manylinux_2_35"),  # Ubuntu 22.04, the oldest
                *("--only-binary", ":all:", "--no-binary", FROM_SOURCE),
                *("--constraint", str(CONSTRAINTS), str(wanted)),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode != 0:
        return done.stderr.strip()
    pinned = {canonicalize_name(Requirement(line).name) for line in pin_lines()}
    resolved = [line.strip() for line in done.stdout.splitlines() if "==" in line]
    missing = [one for one in resolved if canonicalize_name(Requirement(one).name) not in pinned]
    return f"without a pin: {', '.join(missing)}" if missing else ""


def main() -> int:
    """Resolve for each Python, print what does not fit, and record a success."""
    refused = False
    for python, system in PYTHONS.items():
        fault = faults(python)
        print(f"Python {python} ({system}): {fault or 'every pin fits'}", flush=True)
        refused = refused or bool(fault)
    if refused:
        return 1
    text = RECORD.sub("", CONSTRAINTS.read_text())
    head, blank, rest = text.partition("\n\n")
    record = f"# Resolved for Python {', '.join(PYTHONS)}: {digest()}"
    CONSTRAINTS.write_text(f"{head}\n{record}{blank}{rest}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
