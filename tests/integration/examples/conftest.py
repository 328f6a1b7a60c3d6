"""Environment shared by the tests of the example processes."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the examples run: one process, one core
