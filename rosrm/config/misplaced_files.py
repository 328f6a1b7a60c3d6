"""Warnings about files beside a work file that its processes will not find."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from rosrm.model.relative_files import relative_files
from rosrm.model.values import ProcessSpec


def misplaced_files(specs: Iterable[ProcessSpec], path: str | Path) -> Iterator[str]:
    """Yield a warning for each process with a relative file that is beside the work file alone.

    These are only warnings, because the host may have such a file in the working directory.

    Args:
        specs: processes of a work file.
        path: of the work file.
    """
    folder = Path(path).absolute().parent
    for spec in specs:
        given = spec.working_directory
        found = [word for word in relative_files(spec) if (folder / word).is_file()]
        words = [word for word in found if given is None or not Path(given, word).exists()]
        if words:
            where = f"in {given}" if given else "in a directory of its host"
            yield (
                f"{spec.name}: {' and '.join(map(repr, words))} is in {folder}, but the process "
                f"runs {where}; with `working_directory: .` it runs in the folder of its file"
            )
