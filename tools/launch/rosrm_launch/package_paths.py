"""Paths below the directories of ROS packages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any


class PackagePaths:
    """Paths below the directories of packages, written so that each host finds them."""

    def __init__(self, prefixes: Mapping[str, str]) -> None:
        self._prefixes = prefixes
        roots = "|".join(sorted(map(re.escape, set(prefixes.values())), key=len, reverse=True))
        self._path = re.compile(rf"({roots})/(share|lib)/([A-Za-z0-9_]+)(?![\w.-])")

    def in_texts(self, value: Any) -> Any:
        """Return a value whose texts name packages instead of their directories here."""
        if isinstance(value, str):
            return self._path.sub(self._reference, value) if self._prefixes else value
        if isinstance(value, list):
            return [self.in_texts(one) for one in value]
        if isinstance(value, Mapping):
            return {key: self.in_texts(one) for key, one in value.items()}
        return value

    def has(self, path: str) -> bool:
        """Return True for a path below the directory of a package."""
        return bool(self.in_texts(path) != path)

    def _reference(self, found: re.Match[str]) -> str:
        prefix, folder, package = found.groups()
        if self._prefixes.get(package) != prefix:
            return found[0]
        if folder == "share":
            return f"$(find-pkg-share {package})"
        return f"$(find-pkg-prefix {package})/lib/{package}"
