"""Lookup of executables of ROS packages in the ament index.

The index is a folder of marker files, which this module reads directly. `ament_index_python` uses
only the AMENT_PREFIX_PATH of the current process, but an instance may have its own. The ROS wheels
set none at all (their packages are in the prefix of their Python).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final

from rosrm.errors import LaunchError
from rosrm.runtime.path_calls import at
from rosrm.shortage import is_directory, is_file
from rosrm.wording import get_close_matches, listed

_PACKAGES = "share/ament_index/resource_index/packages"
#: Most names that are listed if none is similar.
_FEW: Final = 8
#: Least similarity of a suggested name: `tracetools` has 0.67 to `image_tools`.
_SIMILAR: Final = 0.7


def search_path(environment: Mapping[str, str], python: str) -> list[Path]:
    """Return the prefixes to search: AMENT_PREFIX_PATH, then the prefix of this Python."""
    return list(_prefixes(environment.get("AMENT_PREFIX_PATH", ""), python))


@lru_cache(maxsize=16)
def _prefixes(ament: str, python: str) -> tuple[Path, ...]:
    named = tuple(Path(part) for part in ament.split(":") if part)
    own = Path(python).absolute().parent.parent  # not resolved: a venv's python is a link
    return named if own in named else (*named, own)


def find_executable(package: str, executable: str, prefixes: Sequence[Path]) -> Path:
    """Return the file PREFIX/lib/PACKAGE/EXECUTABLE.

    Raises:
        LaunchError: not found; the message has the searched places and similar names.
    """
    prefix = find_package(package, prefixes)
    path = prefix / "lib" / package / executable
    at(path)
    if not is_file(path):
        near = _near(executable, _executables(path.parent))
        raise LaunchError(
            f"the package {package!r} has no executable {executable!r}: "
            f"looked for {path}{near or '; the package has none at all'}"
        )
    if not os.access(path, os.X_OK):
        raise LaunchError(f"{path} of the package {package!r} is there, but is not executable")
    return path


def find_package(package: str, prefixes: Sequence[Path]) -> Path:
    """Return the prefix of a package; raises `LaunchError` with the searched places."""
    for prefix in prefixes:
        at(prefix)
        if is_file(prefix / _PACKAGES / package):
            return prefix
    where = ", ".join(str(prefix) for prefix in prefixes)
    known = {name for prefix in prefixes for name in _listed(prefix / _PACKAGES)}
    near = _near(package, sorted(known))
    raise LaunchError(
        f"the ROS package {package!r} was not found{near or '; no package was found at all'}\n"
        f"searched: {where} (AMENT_PREFIX_PATH and the prefix of this Python)"
    )


def _executables(folder: Path) -> list[str]:
    return [name for name in _listed(folder) if os.access(folder / name, os.X_OK)]


def _listed(folder: Path) -> list[str]:
    at(folder)
    return sorted(entry.name for entry in folder.iterdir()) if is_directory(folder) else []


def _near(name: str, known: Sequence[str]) -> str:
    """Return a hint with similar names or the existing ones; "" if there are no names."""
    if not known:
        return ""
    close = get_close_matches(name, known, n=3, cutoff=_SIMILAR)
    close = close or [other for other in known if name in other][:3]
    if close:
        return f"; did you mean {listed(close, 'or')}?"
    if len(known) > _FEW:
        return f"; none of the {len(known)} that are there has a similar name"
    return f"; there: {listed(known)}"
