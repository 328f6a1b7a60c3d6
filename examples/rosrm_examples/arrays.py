"""The array types that the modules share."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Points: TypeAlias = NDArray[np.floating[Any]]  # (N, 3) metres, float32 or float64
Flags: TypeAlias = NDArray[np.bool_]
Keys: TypeAlias = NDArray[np.int64]  # packed voxels, see voxels.py
Arrays: TypeAlias = dict[str, NDArray[Any]]  # a state by name, fit for an npz without pickle
