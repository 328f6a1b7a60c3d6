"""Messages of CRIU's image files, in the encoding of Protocol Buffers. Pure.

An image file consists of two magic numbers and messages, each preceded by its size. What is no such
file raises `ValueError`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

#: Bytes before the first message.
MAGIC: Final = 8
#: Wire types: varint; eight bytes; bytes preceded by their length; four bytes.
_NUMBER, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
_FIXED: Final = {_EIGHT: 8, _FOUR: 4}
#: Bits of the largest varint.
_BITS: Final = 70


class Field(NamedTuple):
    """One field of a message.

    Attributes:
        number: of the field.
        value: bytes where their length precedes them; otherwise a number.
        raw: the field as it is encoded.
    """

    number: int
    value: int | bytes
    raw: bytes


def messages(data: bytes) -> Iterator[bytes]:
    """Yield the messages of an image file."""
    position = MAGIC
    while position < len(data):
        if position + 4 > len(data):
            raise ValueError("it ends within the size of a message")
        (size,) = struct.unpack_from("<I", data, position)
        position += 4 + size
        yield _piece(data, position - size, position)


def fields(message: bytes) -> Iterator[Field]:
    """Yield the fields of a message."""
    position = 0
    while position < len(message):
        begin = position
        key, position = _varint(message, position)
        wire = key & 7
        value: int | bytes
        if wire == _NUMBER:
            value, position = _varint(message, position)
        elif wire == _BYTES:
            size, start = _varint(message, position)
            position = start + size
            value = _piece(message, start, position)
        elif wire in _FIXED:
            position += _FIXED[wire]
            value = int.from_bytes(_piece(message, position - _FIXED[wire], position), "little")
        else:
            raise ValueError(f"there is no wire type {wire}")
        yield Field(key >> 3, value, message[begin:position])


def numbers(value: int | bytes) -> Iterator[int]:
    """Yield the numbers of a repeated field, which may be packed."""
    if isinstance(value, int):
        yield value
        return
    position = 0
    while position < len(value):
        number, position = _varint(value, position)
        yield number


def encoded_number(number: int, value: int) -> bytes:
    """Return a field with a number as it is encoded."""
    return _encoded(number << 3 | _NUMBER) + _encoded(value)


def encoded_bytes(number: int, value: bytes) -> bytes:
    """Return a field of bytes as it is encoded."""
    return _encoded(number << 3 | _BYTES) + _encoded(len(value)) + value


def _piece(data: bytes, begin: int, end: int) -> bytes:
    if end > len(data):
        raise ValueError("it ends within a field")
    return data[begin:end]


def _varint(message: bytes, position: int) -> tuple[int, int]:
    """Return a varint and the position after it."""
    number = shift = 0
    while True:
        if position >= len(message) or shift >= _BITS:
            raise ValueError("it ends within a number, or has one that is too large")
        byte = message[position]
        position += 1
        number |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return number, position


def _encoded(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)
