"""A process that can open no further file."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator

#: Descriptors that the test may use up.
_LIMIT = 256


@contextlib.contextmanager
def no_more_files() -> Iterator[None]:
    """Let no further file be opened in this process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    held: list[int] = []
    resource.setrlimit(resource.RLIMIT_NOFILE, (_LIMIT, hard))
    try:
        with contextlib.suppress(OSError):
            while True:
                held.append(os.dup(0))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for file in held:
            os.close(file)
