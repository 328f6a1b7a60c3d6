"""Pure parts of the C++ core, with the interface of their counterparts in `rosrm.node.handoff`."""

from __future__ import annotations

import ctypes
from array import array
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from rclpy.serialization import serialize_message

from rosrm.node.handoff.buffer import Known
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import CoveredInput, StateMark, StatePart
from tests.cpp.core_library import loaded

_F64, _I64, _U64, _SIZE = ctypes.c_double, ctypes.c_int64, ctypes.c_uint64, ctypes.c_size_t
#: Most letters of a topic.
_ROOM: Final = 256


class CppInputBuffer:
    """`InputBuffer` in C++; the messages have no content."""

    def __init__(self, core: Path, limit: int, room: int, now: float) -> None:
        self._core = loaded(core)
        self._handle = ctypes.c_void_p(self._core.buffer_new(_SIZE(limit), _SIZE(room), _F64(now)))

    def __del__(self) -> None:
        self._core.buffer_free(self._handle)

    def mix(self, topic: str) -> None:
        self._core.buffer_mix(self._handle, topic.encode())

    def add(self, topic: str, sent: Any, item: Any, now: float, size: int = 0) -> bool:
        del item
        number = _U64(sent.number or 0)
        add = self._core.buffer_add
        return bool(
            add(self._handle, topic.encode(), _I64(sent.stamp), number, _F64(now), _SIZE(size))
        )

    def cover(
        self, topic: str, stamps: Iterable[int], *, processed: int, single: bool, now: float
    ) -> None:
        values = list(stamps)
        data = (_I64 * len(values))(*values)
        self._core.buffer_cover(
            self._handle, topic.encode(), data, _SIZE(len(values)), _U64(processed), int(single),
            _F64(now),
        )  # fmt: skip

    def known(self, topic: str) -> Known:
        return list(Known)[self._core.buffer_known(self._handle, topic.encode())]

    def overran(self, topic: str) -> None:
        self._core.buffer_overran(self._handle, topic.encode())

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "is_last":
            self._core.buffer_set_last(self._handle)
        super().__setattr__(name, value)

    def overlaps(self, topic: str) -> bool:
        return bool(self._core.buffer_overlaps(self._handle, topic.encode()))

    def is_behind(self, topic: str) -> bool:
        return bool(self._core.buffer_is_behind(self._handle, topic.encode()))

    def misses_one(self, topic: str) -> bool:
        return bool(self._core.buffer_misses_one(self._handle, topic.encode()))

    def is_idle(self, topic: str, now: float, since: float, for_seconds: float) -> bool:
        times = _F64(now), _F64(since), _F64(for_seconds)
        return bool(self._core.buffer_is_idle(self._handle, topic.encode(), *times))

    def take(self) -> Any:
        topic, stamp = ctypes.create_string_buffer(_ROOM), _I64()
        if not self._core.buffer_take(self._handle, topic, _SIZE(_ROOM), ctypes.byref(stamp)):
            return None
        return SimpleNamespace(topic=topic.value.decode(), stamp=stamp.value)


class CppCutAssembler:
    """`CutAssembler` in C++."""

    def __init__(self, core: Path, most_bytes: int, most_marks: int, most_entries: int) -> None:
        self._core = loaded(core)
        self._handle = ctypes.c_void_p(
            self._core.cuts_new(_U64(most_bytes), _SIZE(most_marks), _SIZE(most_entries))
        )

    def __del__(self) -> None:
        self._core.cuts_free(self._handle)

    def expect(self, topic: str) -> None:
        self._core.cuts_expect(self._handle, topic.encode())

    def add_part(self, topic: str, data: bytes) -> None:
        self._core.cuts_add_part(self._handle, topic.encode(), data, _SIZE(len(data)))

    def add_mark(self, mark: Any, now: float) -> bool:
        inputs = [
            CoveredInput(topic=one.topic, covered=array("q", one.covered)) for one in mark.inputs
        ]
        parts = [StatePart(topic=one.topic, size=one.size, digest=one.digest) for one in mark.parts]
        message = StateMark(
            protocol_version=PROTOCOL_VERSION, sequence=mark.sequence, parts=parts, inputs=inputs
        )
        data = serialize_message(message)
        return bool(self._core.cuts_add_mark(self._handle, data, _SIZE(len(data)), _F64(now)))

    def take(self) -> Any:
        arrived, sequence, *parts = [*self._text("cuts_take"), ""]
        if not arrived:
            return None
        found = dict(one.split("=") for one in parts if one)
        return SimpleNamespace(
            mark=SimpleNamespace(sequence=int(sequence)), arrived=float(arrived),
            parts={topic: data.encode() for topic, data in found.items()},
        )  # fmt: skip

    def _text(self, function: str) -> list[str]:
        return str(getattr(self._core, function)(self._handle).decode()).split(" ")

    def missing(self) -> list[str]:
        return [one for one in self._text("cuts_missing") if one]

    def stored(self, topic: str) -> int:
        return int(self._core.cuts_stored(self._handle, topic.encode()))
