"""Messages of rosrm, made, written and read without rclpy.

rclpy makes each message with the defaults of all its fields, and each nested message once more. So
for the spec of a process, with 18 nested messages, this module takes a sixth of the time. A test
compares the results.

Most nested messages have the same content as an earlier one, above all the policies of processes. A
CDR form ends where its content says. So bytes that begin like an earlier form, at the same
alignment, are that message again, and the reader returns the same object. The writer caches the
form of a nested message by the identity of the object. A message that was received or sent must
therefore not be changed, except for its outermost fields.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from itertools import groupby
from typing import Any, Final

from rosrm.model.remembered import remembered
from rosrm_msgs import msg

#: Encapsulation that this module reads: little-endian plain CDR, no options.
_HEADER: Final = b"\x00\x01"
_HEADER_BYTES: Final = 4
_LENGTH: Final = struct.Struct("<I").unpack_from
_pack_count: Final = struct.Struct("<I").pack
#: Largest alignment in CDR.
_ALIGNMENT: Final = 8
#: Padding before a value, by its number of bytes.
_PADDING: Final = [bytes(count) for count in range(_ALIGNMENT)]
#: Forms of one nested message that are kept for each alignment, and most bytes of one.
_KEPT: Final = 4
_MOST_BYTES: Final = 512
#: Code for `struct` and `array` of each type of numbers. No message has an array of fixed length.
_CODES: Final = {
    "boolean": "?", "octet": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h",
    "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q", "float": "f", "double": "d",
}  # fmt: skip

#: Returns a value and the offset behind it, given the content and the offset of the value.
_Reader = Callable[[bytes, int], tuple[Any, int]]
#: Adds the form of a value to the parts; takes the offset of the value, returns that behind it.
_Writer = Callable[[Any, list[bytes], int], int]


def made(kind: Any, /, **fields: Any) -> Any:
    """Return a message with all its fields, without the defaults that its constructor makes."""
    message = kind.__new__(kind)
    message._check_fields = False  # noqa: SLF001 - as the constructor does
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def read(kind: Any, data: bytes) -> Any:
    """Return a message of a type of rosrm.

    Raises:
        ValueError: the data is no such message.
    """
    if data[:2] != _HEADER:
        raise ValueError("it is not little-endian plain CDR")
    content = bytes(data[_HEADER_BYTES:])
    try:
        return _message_reader(kind)(content, 0)[0]
    except struct.error:
        raise _short() from None


def _short() -> ValueError:
    return ValueError("it is too short")


def _new_reader(kind: Any) -> _Reader:
    fields = [*_fields_to_read(kind.get_fields_and_field_types())]

    def read_message(content: bytes, at: int) -> tuple[Any, int]:
        message = kind.__new__(kind)
        message._check_fields = False  # noqa: SLF001 - as the constructor does
        for name, read_field in fields:
            value, at = read_field(content, at)
            if isinstance(name, str):
                setattr(message, name, value)
                continue
            for one, number in zip(name, value, strict=True):
                setattr(message, one, number)
        return message, at if fields else at + 1  # a message without fields has one byte

    return read_message


#: Typed, because mypy does not accept a type as an argument of a cache.
_message_reader: Final[Callable[[Any], _Reader]] = cache(_new_reader)


def _fields_to_read(
    declared: Mapping[str, str],
) -> Iterator[tuple[str | tuple[str, ...], _Reader]]:
    """Yield each field's attribute with its reader; adjacent numbers are read by one reader."""
    for are_numbers, group in groupby(declared.items(), lambda one: one[1] in _CODES):
        if are_numbers:
            names, types = zip(*group, strict=True)
            yield (
                tuple(f"_{name}" for name in names),
                _numbers_reader("".join(map(_CODES.__getitem__, types))),
            )
        else:
            yield from ((f"_{name}", _reader(type_)) for name, type_ in group)


def _reader(declared: str) -> _Reader:
    """Return the reader of a field by its type, as rosidl writes it."""
    if declared == "string":
        return _read_text
    if declared.startswith("sequence<"):
        return _sequence_reader(declared.removeprefix("sequence<").removesuffix(">"))
    return _known(_message_reader(_kind(declared)))


def _kind(declared: str) -> Any:
    return getattr(msg, declared.removeprefix("rosrm_msgs/"))


def _known(read_new: _Reader) -> _Reader:
    """Return a reader that finds the messages that were read last."""
    kept: list[list[tuple[bytes, Any]]] = [[] for _ in range(_ALIGNMENT)]

    def read_known(content: bytes, at: int) -> tuple[Any, int]:
        latest = kept[at % _ALIGNMENT]
        for form, message in latest:
            if content.startswith(form, at):
                return message, at + len(form)
        message, end = read_new(content, at)
        if end - at <= _MOST_BYTES:
            latest.insert(0, (content[at:end], message))
            del latest[_KEPT:]
        return message, end

    return read_known


def _read_text(content: bytes, at: int) -> tuple[str, int]:
    at += -at % 4
    (length,) = _LENGTH(content, at)
    begin, end = at + 4, at + 4 + length
    if end > len(content):
        raise _short()
    if length == 1 and not content[begin]:
        return "", end
    # As in rclpy, a text ends at its first NUL, which no path or argument may have.
    return content[begin:end].split(b"\0", 1)[0].decode("utf-8", "replace"), end


def _numbers_reader(codes: str) -> _Reader:
    """Return the reader of adjacent numbers of these types."""
    forms = [_form_at(alignment, codes) for alignment in range(_ALIGNMENT)]

    def read_numbers(content: bytes, at: int) -> tuple[tuple[Any, ...], int]:
        form = forms[at % _ALIGNMENT]
        return form.unpack_from(content, at), at + form.size

    return read_numbers


def _form_at(at: int, codes: str) -> struct.Struct:
    """Return the struct of adjacent numbers with their padding, of which the first is at `at`."""
    layout = "<"
    for code in codes:
        size = struct.calcsize(f"<{code}")
        gap = -at % size
        layout += f"{gap}x{code}"
        at += gap + size
    return struct.Struct(layout)


def _sequence_reader(inner: str) -> _Reader:
    if inner in _CODES:
        return _array_reader(_CODES[inner])
    read_one = _read_text if inner == "string" else _message_reader(_kind(inner))

    def read_sequence(content: bytes, at: int) -> tuple[list[Any], int]:
        at += -at % 4
        (count,) = _LENGTH(content, at)
        at += 4
        if count > len(content) - at:  # each entry has a byte at least
            raise _short()
        found = []
        for _ in range(count):
            one, at = read_one(content, at)
            found.append(one)
        return found, at

    return read_sequence


def _array_reader(code: str) -> _Reader:
    size = struct.calcsize(f"<{code}")

    def read_array(content: bytes, at: int) -> tuple[Any, int]:
        at += -at % 4
        (count,) = _LENGTH(content, at)
        at += 4
        if count:
            at += -at % size
        end = at + count * size
        if end > len(content):
            raise _short()
        if code == "?":
            return [byte != 0 for byte in content[at:end]], end
        return array(code, content[at:end]), end

    return read_array


# --- writing ----------------------------------------------------------------------------------


def form_of(message: Any) -> bytes:
    """Return the CDR form of a message of rosrm: by `written` if its type contains a spec.

    Requests too, so that a client needs no rclpy. For other types rclpy is faster, such as long
    lists of flat messages (the rows of a listing).
    """
    if type(message).__name__.endswith("_Request") or _has_specs(type(message)):
        return written(message)
    from rclpy.serialization import serialize_message  # noqa: PLC0415 - see above

    return bytes(serialize_message(message))


def _find_specs(kind: Any) -> bool:
    inner = kind.get_fields_and_field_types().values()
    nested = [one.removeprefix("sequence<").removesuffix(">") for one in inner]
    kinds = [_kind(one) for one in nested if one.startswith("rosrm_msgs/")]
    return kind is msg.ProcessSpec or any(map(_find_specs, kinds))


#: Typed as `_message_reader`.
_has_specs: Final[Callable[[Any], bool]] = cache(_find_specs)


def written(message: Any) -> bytes:
    """Return the CDR form of a message of rosrm, without rclpy.

    Raises:
        ValueError: a field has a value that its type does not allow.
    """
    parts = [_HEADER + bytes(_HEADER_BYTES - len(_HEADER))]
    try:
        _message_writer(type(message))(message, parts, 0)
    except struct.error as fault:
        raise ValueError(f"a field of {type(message).__name__}: {fault}") from None
    return b"".join(parts)


def _new_writer(kind: Any) -> _Writer:
    declared = kind.get_fields_and_field_types()
    fields = [(f"_{name}", _writer(type_)) for name, type_ in declared.items()]

    def write_message(message: Any, parts: list[bytes], at: int) -> int:
        for name, write_field in fields:
            at = write_field(getattr(message, name), parts, at)
        if not fields:
            parts.append(b"\0")  # a message without fields has one byte
            return at + 1
        return at

    return write_message


#: Typed as `_message_reader`.
_message_writer: Final[Callable[[Any], _Writer]] = cache(_new_writer)


def _writer(declared: str) -> _Writer:
    """Return the writer of a field by its type, as rosidl writes it."""
    if declared == "string":
        return _write_text
    if declared.startswith("sequence<"):
        return _sequence_writer(declared.removeprefix("sequence<").removesuffix(">"))
    if declared in _CODES:
        return _number_writer(_CODES[declared])
    return _caching(_message_writer(_kind(declared)))


def _caching(write_new: _Writer) -> _Writer:
    """Return a writer that caches the forms of the newest messages."""

    def form_at(alignment: int, message: Any) -> bytes:
        parts: list[bytes] = []
        write_new(message, parts, alignment)
        return b"".join(parts)

    forms = [
        remembered(partial(form_at, alignment), lambda form: len(form) <= _MOST_BYTES)
        for alignment in range(_ALIGNMENT)
    ]

    def write_known(message: Any, parts: list[bytes], at: int) -> int:
        form = forms[at % _ALIGNMENT](message)
        parts.append(form)
        return at + len(form)

    return write_known


def _write_text(text: str, parts: list[bytes], at: int) -> int:
    form = text.encode() + b"\0"
    length = len(form)
    gap = -at % 4
    parts.append(_PADDING[gap] + _pack_count(length) + form)
    return at + gap + 4 + length


def _number_writer(code: str) -> _Writer:
    form = struct.Struct(f"<{code}")
    size, pack = form.size, form.pack

    def write_number(number: Any, parts: list[bytes], at: int) -> int:
        gap = -at % size
        parts.append(_PADDING[gap] + pack(number) if gap else pack(number))
        return at + gap + size

    return write_number


#: Writes the count of a sequence.
_write_count: Final = _number_writer("I")


def _sequence_writer(inner: str) -> _Writer:
    if inner in _CODES:
        write_numbers = _numbers_writer(_CODES[inner])

        def write_sequence_of_numbers(numbers: Any, parts: list[bytes], at: int) -> int:
            at = _write_count(len(numbers), parts, at)
            return write_numbers(numbers, parts, at) if len(numbers) else at

        return write_sequence_of_numbers
    write_one = _write_text if inner == "string" else _message_writer(_kind(inner))

    def write_sequence(values: Any, parts: list[bytes], at: int) -> int:
        at = _write_count(len(values), parts, at)
        for value in values:
            at = write_one(value, parts, at)
        return at

    return write_sequence


def _numbers_writer(code: str) -> _Writer:
    """Return the writer of numbers without their count."""
    size = struct.calcsize(f"<{code}")

    def write_numbers(numbers: Any, parts: list[bytes], at: int) -> int:
        gap = -at % size
        form = bytes(numbers)  # of an array of this type, or of a list of booleans
        parts.append(bytes(gap) + form)
        return at + gap + len(form)

    return write_numbers
