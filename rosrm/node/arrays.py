"""Numpy arrays as a message, in npz format without pickled objects."""

from __future__ import annotations

import io
import math
import zipfile
from array import array
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy_format

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
        ValueError: the bytes are no npz, hold pickled objects, or claim more than there is.
    """
    packed = io.BytesIO(message.npz)
    try:
        _check_sizes(packed, len(message.npz))
        with np.load(packed, allow_pickle=False) as arrays:
            return {name.removeprefix("_"): arrays[name] for name in arrays.files}
    except Exception as error:  # noqa: BLE001 - numpy and zipfile raise many kinds for foreign bytes
        raise ValueError(f"these {len(message.npz)} bytes are no npz of arrays: {error}") from None


def _check_sizes(packed: io.BytesIO, size: int) -> None:
    """Raise ValueError unless the entries are stored arrays that together fit in the file.

    A deflated entry of some kilobytes, many entries for the same bytes, or the shape of an array
    could otherwise claim more memory than there is.
    """
    with zipfile.ZipFile(packed) as archive:
        entries = archive.infolist()
        if any(one.compress_type != zipfile.ZIP_STORED for one in entries):
            raise ValueError("an entry is compressed")
        if sum(one.file_size for one in entries) > size:
            raise ValueError("its entries claim to be larger than the file")
        for one in entries:
            with archive.open(one) as file:
                if _claimed(file) > one.file_size:
                    raise ValueError(f"{one.filename} claims to be larger than its entry")
    packed.seek(0)


def _claimed(file: IO[bytes]) -> int:
    """Return the bytes that the header of an array claims."""
    first = npy_format.read_magic(file) == (1, 0)
    # Version 3.0 differs from 2.0 only in the letters of field names.
    read = npy_format.read_array_header_1_0 if first else npy_format.read_array_header_2_0
    shape, _, dtype = read(file)
    return math.prod(shape) * max(1, dtype.itemsize)
