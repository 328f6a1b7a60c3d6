"""Types of the numpy arrays in the views of hosts, which plugins also name while they run."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

#: Numpy array of 64-bit floats.
FloatArray = npt.NDArray[np.float64]
#: Numpy array of booleans.
BoolArray = npt.NDArray[np.bool_]
