"""A dump leaves out pages that were copied before, and they are restored from the copy."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from dataclasses import replace
from io import BufferedWriter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosrm.errors import CriuError
from rosrm_criu.engine import copied_pages, image, memory_copy, page_server, protobuf
from rosrm_criu.engine.copied_pages import IN_PARENT, PRESENT, Entry
from rosrm_criu.engine.image import GRANDPARENT, PAGES, PARENT
from rosrm_criu.engine.memory_copy import CHANGES, PAGE, MemoryCopy, PageRange, file_name
from tests.waiting import PATIENCE

PID = 7
#: A process as CRIU names it to a page server.
PROCESS = PID << 8 | 1
OPEN, ADD, HAS_PARENT, END = 4, 6 | PRESENT << 16, 5, 0x1024
NO_PAGES = PageRange(0, 0)
#: Beginning of a pagemap of CRIU 4.2.1: the pages are in file 1, and its first page.
SAMPLE = bytes.fromhex("1943565425400856 020000000801 0e0000000880c0f1b3bcb715100020042801")
#: Contents by number of the page, of one process.
memories = st.dictionaries(st.integers(0, 200), st.integers(0, 2), max_size=150)
FULL = dict.fromkeys(range(200), 1)
#: Most pages in a request of CRIU, and bytes that arrive at once.
pieces = st.tuples(st.integers(1, 250), st.integers(1000, 1_000_000))
WHOLE = (250, 1_000_000)


def content(number: int) -> bytes:
    """Return a page; two different ones differ in their last byte alone."""
    return bytes(PAGE - 1) + bytes([number])


def ranges_of(memory: dict[int, int], most: int = 1000) -> list[PageRange]:
    """Return the pages of a memory as the longest possible ranges of at most so many pages."""
    ranges: list[PageRange] = []
    for page in sorted(memory):
        if ranges and ranges[-1].end == page * PAGE and ranges[-1].pages < most:
            ranges[-1] = PageRange(ranges[-1].begin, ranges[-1].pages + 1)
        else:
            ranges.append(PageRange(page * PAGE, 1))
    return ranges


def pages_of(memory: dict[int, int]) -> bytes:
    return b"".join(content(memory[page]) for page in sorted(memory))


def copied(folder: Path, memory: dict[int, int]) -> MemoryCopy:
    """Return a copy of a memory, beside the folder of an empty image."""
    copies = folder / "copies"
    copies.mkdir()
    (folder / PAGES).mkdir()
    (copies / file_name(PID)).write_bytes(pages_of(memory))
    return MemoryCopy(copies, {PID: ranges_of(memory)})


def copied_again(
    copy: MemoryCopy, before: dict[int, int], between: dict[int, int]
) -> tuple[MemoryCopy, dict[int, int]]:
    """Return a copy with a second one of the pages that have changed, and what both contain."""
    pages = sorted(before)
    marks = [between.get(page, before[page]) != before[page] for page in pages]
    newer = {page: between[page] for page, mark in zip(pages, marks, strict=True) if mark}
    (copy.directory / CHANGES).mkdir()
    (copy.directory / CHANGES / file_name(PID)).write_bytes(pages_of(newer))
    return replace(copy, changed={PID: np.array(marks, np.bool_)}), {**before, **newer}


class Dump:
    """Substitute for a CRIU that dumps to a page server.

    Args:
        to: descriptor of the connection.
        at_once: bytes that are sent at once.
    """

    def __init__(self, to: int, at_once: int = 1_000_000) -> None:
        self._peer, self._at_once = socket.socket(fileno=os.dup(to)), at_once

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self._peer.close()

    def request(self, command: int, which: int, pages=NO_PAGES, answer: int = 0) -> bytes:
        """Send a request; return the answer, of so many bytes."""
        self.send(struct.pack("IQQQ", command, pages.pages, pages.begin, which))
        return self._peer.recv(answer, socket.MSG_WAITALL) if answer else b""

    def send(self, data: bytes) -> None:
        for at in range(0, len(data), self._at_once):
            self._peer.sendall(data[at : at + self._at_once])

    def process(self, which: int, memory: dict[int, int], most: int = 1000) -> None:
        """Send a memory, at most so many pages in a request."""
        assert self.request(HAS_PARENT, which, answer=4) == bytes(4)
        assert self.request(OPEN, which, answer=1) == bytes(1)
        data, at = pages_of(memory), 0
        for pages in ranges_of(memory, most):
            self.request(ADD, which, pages=pages)
            self.send(data[at : at + pages.pages * PAGE])
            at += pages.pages * PAGE

    def end(self) -> None:
        assert self.request(END, 0, answer=4) == bytes(4)


def dumped(folder: Path, copy: MemoryCopy, memory: dict[int, int], how=WHOLE) -> dict[str, int]:
    """Dump a memory through a page server; return the sizes of the files that it names."""
    most, at_once = how

    def run(to: int) -> None:
        with Dump(to, at_once) as dump:
            dump.process(PROCESS, memory, most)
            dump.end()

    sizes = page_server.serve(run, folder, copy)
    assert sizes is not None
    return sizes


def restored(images: Path, name: str = f"pagemap-{PID}.img") -> dict[int, bytes]:
    """Return the pages of an image as CRIU reads them: marked ones from the parent."""
    head, *entries = protobuf.messages((images / name).read_bytes())
    (number,) = (one.value for one in protobuf.fields(head))
    pages = (images / f"pages-{number}.img").read_bytes()
    parent = restored(images / "parent") if (images / "parent").exists() else {}
    found: dict[int, bytes] = {}
    for entry in entries:
        values = {one.number: int(one.value) for one in protobuf.fields(entry)}
        for page in range(values[1] // PAGE, values[1] // PAGE + values[5]):
            if values[4] == IN_PARENT:
                found[page] = parent[page]
            else:
                found[page], pages = pages[:PAGE], pages[PAGE:]
    assert not pages
    return found


def contents(memory: dict[int, int]) -> dict[int, bytes]:
    return {page: content(number) for page, number in memory.items()}


def sent_pages(folder: Path) -> int:
    return (folder / PAGES / "pages-1.img").stat().st_size // PAGE


@given(memories, memories, pieces)
@example(FULL, FULL, WHOLE)
@example(FULL, {**FULL, 3: 2, 64: 2}, (7, 1000))
def test_any_dump_is_restored_exactly_from_its_changed_pages_and_the_copy(before, after, how):
    """Pages may be mapped, unmapped or written after the copy; only the changed ones are written.

    They arrive in pieces of any size.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy = copied(folder, before)
        sizes = dumped(folder, copy, after, how)
        changed = sum(before.get(page) != number for page, number in after.items())
        assert sent_pages(folder) == changed
        uses = {f"{PARENT}/{file_name(PID)}": len(before) * PAGE}
        assert sizes == (uses if changed < len(after) else {})
        copied_pages.move_into_parent(folder, copy.directory)
        assert restored(folder / PAGES) == contents(after)


@given(memories, memories, memories, pieces)
@example(FULL, {**FULL, 3: 2}, FULL, WHOLE)
@example(FULL, {**FULL, 3: 2}, {**FULL, 3: 2, 64: 2}, (7, 1000))
def test_any_dump_is_restored_exactly_from_two_copies(before, between, after, how):
    """The second copy has the pages that had changed by then; the newer content counts."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy, newest = copied_again(copied(folder, before), before, between)
        sizes = dumped(folder, copy, after, how)
        changed = sum(newest.get(page) != number for page, number in after.items())
        assert sent_pages(folder) == changed
        both = {f"{one}/{file_name(PID)}" for one in (PARENT, GRANDPARENT)}
        assert sizes.keys() == (both if changed < len(after) else set())
        named = {**image.file_sizes(folder), **sizes}
        copied_pages.move_into_parent(folder, copy.directory)
        assert image.file_sizes(folder) == named
        assert restored(folder / PAGES) == contents(after)


def test_the_format_is_that_of_criu():
    """The bytes of a pagemap are those of CRIU's file with the same page."""
    _, entry = protobuf.messages(SAMPLE)
    address = next(one.value for one in protobuf.fields(entry) if one.number == 1)
    assert copied_pages.encoded(1, [Entry(PageRange(address, 1), PRESENT)]) == SAMPLE


def test_processes_without_a_copy_and_shared_memory_are_written_whole(tmp_path):
    """A child is new, another one has ended before the dump, and shared memory is not copied."""
    copy = copied(tmp_path, FULL)
    for pid, memory in ((8, {}), (9, {0: 1})):
        (copy.directory / file_name(pid)).write_bytes(pages_of(memory))
    copy = replace(copy, ranges={**copy.ranges, 8: [], 9: ranges_of({0: 1})})
    dumps = {
        f"pagemap-{PID}.img": (PROCESS, {**FULL, 3: 2}),
        "pagemap-8.img": (8 << 8 | 1, {1: 1}),
        "pagemap-10.img": (10 << 8 | 1, {2: 1}),
        "pagemap-shmem-7.img": (7 << 8 | 2, FULL),
    }

    def run(to: int) -> None:
        with Dump(to) as dump:
            for which, memory in dumps.values():
                dump.process(which, memory)
            dump.end()

    sizes = page_server.serve(run, tmp_path, copy)
    named = {**image.file_sizes(tmp_path), **sizes}
    copied_pages.move_into_parent(tmp_path, copy.directory)
    assert image.file_sizes(tmp_path) == named
    for name, (_, memory) in dumps.items():
        assert restored(tmp_path / PAGES, name) == contents(memory)


@pytest.mark.parametrize(
    ("command", "which"),
    [
        (9, PROCESS),  # unknown
        (6 | IN_PARENT << 16, PROCESS),  # pages that are not sent
        (6 | (8 | PRESENT) << 16, PROCESS),  # an unknown flag
        (ADD, PROCESS + (1 << 8)),  # pages of another process
        (OPEN, 9),  # an image of another kind
    ],
)
def test_an_unexpected_request_ends_the_connection_and_allows_another_dump(
    tmp_path, command, which
):
    """CRIU then lets the processes run on, and they can be dumped whole."""
    answers = []

    def run(to: int) -> None:
        with Dump(to) as dump:
            dump.request(OPEN, PROCESS, answer=1)
            answers.append(dump.request(command, which, pages=PageRange(0, 1), answer=1))
            raise CriuError("the page server does not answer")

    assert page_server.serve(run, tmp_path, copied(tmp_path, FULL)) is None
    assert answers == [b""]


def test_a_full_disk_allows_another_dump(tmp_path, monkeypatch):
    """The first dump may have filled the disk, but its files are removed before the second."""

    def new_file(_: Path) -> BufferedWriter:
        return Path("/dev/full").open("wb")

    monkeypatch.setattr(page_server, "new_file", new_file)

    def run(to: int) -> None:
        with Dump(to) as dump:
            dump.process(PROCESS, dict.fromkeys(range(200), 2))
            with pytest.raises((OSError, AssertionError)):
                dump.end()
        raise CriuError("the page server does not answer")

    assert page_server.serve(run, tmp_path, copied(tmp_path, FULL)) is None


def test_a_process_that_outlives_criu_does_not_hold_up_the_dump(tmp_path):
    """The process has inherited CRIU's end of the connection. The node is frozen until the end."""
    timers = []

    def run(to: int) -> None:
        timers.append(threading.Timer(PATIENCE, os.close, [os.dup(to)]))
        timers[0].start()
        raise CriuError("it was killed")

    with pytest.raises(CriuError, match="it was killed"):
        page_server.serve(run, tmp_path, copied(tmp_path, FULL))
    assert timers[0].is_alive()
    timers[0].cancel()
    os.close(*timers[0].args)


def test_a_copy_of_another_size_allows_another_dump(tmp_path):
    """The pages of such a copy cannot be assigned to their addresses."""
    copy = copied(tmp_path, FULL)
    with (copy.directory / file_name(PID)).open("ab") as file:
        file.write(content(0))

    def run(to: int) -> None:
        with Dump(to) as dump:
            dump.request(OPEN, PROCESS, answer=1)
        raise CriuError("the page server does not answer")

    assert page_server.serve(run, tmp_path, copy) is None


@pytest.mark.parametrize("code", [0, 1])
def test_a_criu_that_ends_early_leaves_no_image(tmp_path, code):
    """Its own error is reported; without an error, the processes can be dumped again."""

    def run(to: int) -> None:
        with Dump(to) as dump:
            dump.request(OPEN, PROCESS, answer=1)
            dump.request(ADD, PROCESS, pages=PageRange(0, 2))
            dump.send(content(1))
        if code:
            raise CriuError("it cannot be dumped")

    copy = copied(tmp_path, FULL)
    if code:
        with pytest.raises(CriuError, match="cannot be dumped"):
            page_server.serve(run, tmp_path, copy)
    else:
        assert page_server.serve(run, tmp_path, copy) is None
    assert not (tmp_path / PAGES / f"pagemap-{PID}.img").exists()


# --- the copy ---------------------------------------------------------------------------------

#: Maps 1 MiB of ones and 1 MiB that it never touches, and prints their address. For each line of
#: input it changes the fourth page.
HOLDER = """
import ctypes, mmap, sys
area = mmap.mmap(-1, 1 << 21, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
area[:1 << 20] = bytes([1]) * (1 << 20)
begin = ctypes.addressof(ctypes.c_char.from_buffer(area))
print(begin, flush=True)
for line in sys.stdin:
    area[3 * mmap.PAGESIZE] += 1
    print(begin, flush=True)
"""


@pytest.fixture
def holder():
    """Yield a process that holds memory; it ends with its input."""
    with subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        yield process


def test_the_memory_of_a_running_process_is_copied(tmp_path, holder):
    """Its pages are in the file in order, without those that it never touched."""
    begin = int(holder.stdout.readline())
    copy = memory_copy.copy([holder.pid], tmp_path / "copy", lambda: None)
    file = copy.directory / file_name(holder.pid)
    found, at, data = {}, 0, file.read_bytes()
    for one in copy.ranges[holder.pid]:
        for page in range(one.pages):
            found[one.begin + page * PAGE] = data[at : at + PAGE]
            at += PAGE
    assert at == len(data)
    # No upper bound: pages that were only read are copied, but do not count as anonymous memory.
    assert memory_copy.size_of([holder.pid]) >= 1 << 20
    assert all(found[begin + offset] == b"\1" * PAGE for offset in range(0, 1 << 20, PAGE))
    assert not any(begin + offset in found for offset in range(1 << 20, 1 << 21, PAGE))
    assert copy.directory.stat().st_mode & 0o777 == 0o700
    assert file.stat().st_mode & 0o777 == 0o600


def test_an_area_that_is_listed_twice_is_copied_once(tmp_path, holder, monkeypatch):
    """The area grows while the kernel lists it. CRIU would restore the first copy of a page."""
    begin = int(holder.stdout.readline())
    areas = ((begin, 1 << 19), (begin, 1 << 20), (begin + (1 << 18), 1 << 18))
    text = "".join(
        f"{start:x}-{start + size:x} rw-p 00000000 00:00 0\nAnonymous: {size >> 10} kB\n"
        for start, size in areas
    )
    monkeypatch.setattr(memory_copy.Path, "read_text", lambda *_, **__: text)
    copy = memory_copy.copy([holder.pid], tmp_path / "copy", lambda: None)
    half = (1 << 19) // PAGE
    assert copy.ranges[holder.pid] == [
        PageRange(begin, half),
        PageRange(begin + (1 << 19), half),
    ]
    assert (copy.directory / file_name(holder.pid)).stat().st_size == 1 << 20


def test_what_has_changed_since_is_copied_once_more(tmp_path, holder):
    """The new pages are in a file of their own, and the first copy stays as it was."""
    begin = int(holder.stdout.readline())
    first = memory_copy.copy([holder.pid], tmp_path / "copy", lambda: None)
    before = (first.directory / file_name(holder.pid)).read_bytes()
    holder.stdin.write(b"\n")
    holder.stdin.flush()
    assert int(holder.stdout.readline()) == begin
    copy = memory_copy.copy_changes(first, [holder.pid], lambda: None)
    pages = [
        one.begin + page * PAGE for one in copy.ranges[holder.pid] for page in range(one.pages)
    ]
    changed = [page for page, mark in zip(pages, copy.changed[holder.pid], strict=True) if mark]
    data = (copy.directory / CHANGES / file_name(holder.pid)).read_bytes()
    assert len(data) == len(changed) * PAGE
    at = changed.index(begin + 3 * PAGE) * PAGE
    assert data[at : at + PAGE] == b"\2" + b"\1" * (PAGE - 1)
    assert begin + 4 * PAGE not in changed
    assert (first.directory / file_name(holder.pid)).read_bytes() == before


def too_late() -> None:
    raise ValueError("it is too late")


def test_a_copy_can_be_ended(tmp_path, holder):
    """A process with much memory on a slow disk does not hold up its move."""
    assert holder.stdout.readline()
    with pytest.raises(ValueError, match="too late"):
        memory_copy.copy([holder.pid], tmp_path / "copy", too_late)
