"""The directories of ROS packages on this host, in the texts of a spec."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rosrm.errors import LaunchError
from rosrm.model.values import ProcessSpec
from rosrm.slave.launch.ament_index import find_package
from rosrm.slave.launch.placeholders import with_texts

_REFERENCE: Final = re.compile(r"\$\(find-pkg-(share|prefix) +([A-Za-z0-9_.-]+)\)")


def with_packages(spec: ProcessSpec, prefixes: Sequence[Path]) -> ProcessSpec:
    """Return a spec with directories in place of `$(find-pkg-share X)` and `$(find-pkg-prefix X)`.

    Args:
        prefixes: prefixes of the ament index on this host.

    Raises:
        LaunchError: a package is not there, or the process runs in the image of a container.
    """

    def directory(found: re.Match[str]) -> str:
        if spec.container.image:
            raise LaunchError(
                f"{found[0]}: the packages in the image of a container are not known here; write "
                "the path in the image"
            )
        prefix = find_package(found[2], prefixes)
        return str(prefix / "share" / found[2] if found[1] == "share" else prefix)

    return with_texts(spec, lambda text: _REFERENCE.sub(directory, text))
