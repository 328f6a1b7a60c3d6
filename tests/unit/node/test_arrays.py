"""Arrays in messages: npz without pickle, in both directions."""

from __future__ import annotations

import io
from array import array

import numpy as np
import pytest

from rosrm.node import arrays_message, arrays_of
from rosrm_msgs.msg import Arrays


def test_arrays_come_back_with_their_types_and_shapes():
    """Arrays are equal bit by bit, under any names."""
    arrays = {
        "poses": np.random.default_rng(1).normal(size=(3, 4, 4)),
        "file": np.array([1, 2, 3], dtype=np.int16),
        "name": np.array("lidar"),
        "empty": np.zeros((0, 3), dtype=np.float32),
    }
    back = arrays_of(arrays_message(arrays))
    assert back.keys() == arrays.keys()
    for name, value in arrays.items():
        assert back[name].dtype == value.dtype
        np.testing.assert_array_equal(back[name], value)


def test_python_objects_are_refused():
    """Numpy would pickle them."""
    with pytest.raises(ValueError, match="'map' holds Python objects"):
        arrays_message({"map": np.array([{}, 1], dtype=object)})


def test_what_is_pickled_is_not_read():
    """Unpickling runs code of the sender."""
    packed = io.BytesIO()
    np.savez(packed, evil=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="no npz of arrays"):
        arrays_of(Arrays(npz=array("B", packed.getvalue())))


def test_what_is_no_npz_is_refused():
    """The error is one sentence, without a traceback of zipfile."""
    with pytest.raises(ValueError, match="these 3 bytes are no npz"):
        arrays_of(Arrays(npz=array("B", b"abc")))
