"""Numpy arrays as a message, in npz format without pickled objects."""

from __future__ import annotations

import io
from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rosrm_msgs.msg import Arrays


def arrays_message(arrays: Mapping[str, npt.ArrayLike]) -> Arrays:
    """Pack arrays by name, with their types and shapes.

    Raises:
        ValueError: an array holds Python objects, which would have to be pickled.
    """
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    for name, value in plain.items():
        if value.dtype.hasobject:
            raise ValueError(
                f"the array {name!r} holds Python objects: numbers or text are required"
            )
    packed = io.BytesIO()
    # The prefix makes every name usable: `savez` has an argument called "file" itself.
    np.savez(packed, **{f"_{name}": value for name, value in plain.items()})  # type: ignore[arg-type]
    return Arrays(npz=array("B", packed.getvalue()))


def arrays_of(message: Arrays) -> dict[str, npt.NDArray[Any]]:
    """Unpack a message of `arrays_message`.

    Raises:
        ValueError: the bytes are no npz, or hold pickled objects.
    """
    try:
        with np.load(io.BytesIO(message.npz), allow_pickle=False) as packed:
            return {name.removeprefix("_"): packed[name] for name in packed.files}
    except (OSError, EOFError, KeyError, ValueError) as error:
        raise ValueError(f"these {len(message.npz)} bytes are no npz of arrays: {error}") from None
