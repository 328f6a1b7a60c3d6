"""Check of files with secrets."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Final

from rosrm.errors import ConfigError
from rosrm.wording import reason_of

_OTHERS: Final = 0o077


def check_private(option: str, path: Path) -> None:
    """Refuse a file with a secret that is missing, or that other users can read."""
    try:
        state = path.stat()
    except OSError as error:
        raise ConfigError(f"{option} {path}: cannot be read: {reason_of(error)}") from None
    if not stat.S_ISREG(state.st_mode):
        raise ConfigError(f"{option} {path}: a file is required")
    if stat.S_IMODE(state.st_mode) & _OTHERS:
        raise ConfigError(
            f"{option} {path}: other users can read or change it; `chmod 600 {path}` ends that"
        )
