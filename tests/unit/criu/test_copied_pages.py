"""Pages of a dump that were copied before are left out, and are restored from the copy."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosrm_criu.engine import copied_pages, image, memory_copy, protobuf
from rosrm_criu.engine.copied_pages import Entry, Pagemap
from rosrm_criu.engine.image import GRANDPARENT, PAGES, PARENT
from rosrm_criu.engine.memory_copy import CHANGES, PAGE, MemoryCopy, PageRange, file_name

PID = 7
IN_PARENT, PRESENT = 1, 4
#: Beginning of a pagemap of CRIU 4.2.1: the pages are in file 1, and its first page.
SAMPLE = bytes.fromhex("1943565425400856 020000000801 0e0000000880c0f1b3bcb715100020042801")
#: Contents by number of the page, of one process.
memories = st.dictionaries(st.integers(0, 200), st.integers(0, 2), max_size=150)
FULL = dict.fromkeys(range(200), 1)


def content(number: int) -> bytes:
    """Return a page; two different ones differ in their last byte alone."""
    return bytes(PAGE - 1) + bytes([number])


def ranges_of(memory: dict[int, int]) -> list[PageRange]:
    """Return the pages of a memory as the longest possible ranges."""
    ranges: list[PageRange] = []
    for page in sorted(memory):
        if ranges and ranges[-1].end == page * PAGE:
            ranges[-1] = PageRange(ranges[-1].begin, ranges[-1].pages + 1)
        else:
            ranges.append(PageRange(page * PAGE, 1))
    return ranges


def write_pages(path: Path, memory: dict[int, int]) -> None:
    path.write_bytes(b"".join(content(memory[page]) for page in sorted(memory)))


def dump_after_copy(folder: Path, before: dict[int, int], after: dict[int, int]) -> MemoryCopy:
    """Write the image of a memory, and a copy of it at an earlier time; return the copy."""
    images, copies = folder / PAGES, folder / "copies"
    images.mkdir()
    copies.mkdir()
    entries = [Entry(one, PRESENT) for one in ranges_of(after)]
    pagemap = Pagemap(SAMPLE[: protobuf.MAGIC], 1, entries)
    (images / f"pagemap-{PID}.img").write_bytes(pagemap.encoded())
    write_pages(images / "pages-1.img", after)
    write_pages(copies / file_name(PID), before)
    return MemoryCopy(copies, {PID: ranges_of(before)})


def copied_again(
    copy: MemoryCopy, before: dict[int, int], between: dict[int, int]
) -> tuple[MemoryCopy, dict[int, int]]:
    """Return a copy with a second one of the pages that have changed, and what both contain."""
    pages = sorted(before)
    marks = [between.get(page, before[page]) != before[page] for page in pages]
    newer = {page: between[page] for page, mark in zip(pages, marks, strict=True) if mark}
    (copy.directory / CHANGES).mkdir()
    write_pages(copy.directory / CHANGES / file_name(PID), newer)
    return replace(copy, changed={PID: np.array(marks, np.bool_)}), {**before, **newer}


def restored(images: Path) -> dict[int, bytes]:
    """Return the pages of an image as CRIU reads them: marked ones from the parent."""
    head, *entries = protobuf.messages((images / f"pagemap-{PID}.img").read_bytes())
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


@given(memories, memories)
@example(FULL, FULL)
@example(FULL, {**FULL, 3: 2, 64: 2})
def test_any_dump_is_restored_exactly_from_its_changed_pages_and_the_copy(before, after):
    """Pages may be mapped, unmapped or written after the copy; only the changed ones are sent.

    A dump with few equal pages is sent whole.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy = dump_after_copy(folder, before, after)
        sizes = copied_pages.remove_copied_pages(folder, copy, lambda: None)
        sent = (folder / PAGES / "pages-1.img").stat().st_size // PAGE
        copied_pages.move_into_parent(folder, copy.directory)
        expected = {page: content(number) for page, number in after.items()}
        changed = sum(before.get(page) != number for page, number in after.items())
        assert restored(folder / PAGES) == expected
        if before and (len(after) - changed) * 8 >= len(after):
            assert sent == changed
            assert sizes == {f"{PARENT}/{file_name(PID)}": len(before) * PAGE}
        else:
            assert sent == len(after)
            assert sizes == {}


@given(memories, memories, memories)
@example(FULL, {**FULL, 3: 2}, FULL)
@example(FULL, {**FULL, 3: 2}, {**FULL, 3: 2, 64: 2})
def test_any_dump_is_restored_exactly_from_two_copies(before, between, after):
    """The second copy has the pages that had changed by then; the newer content counts."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy, newest = copied_again(dump_after_copy(folder, before, after), before, between)
        sizes = copied_pages.remove_copied_pages(folder, copy, lambda: None)
        sent = (folder / PAGES / "pages-1.img").stat().st_size // PAGE
        named = {**image.file_sizes(folder), **sizes}
        copied_pages.move_into_parent(folder, copy.directory)
        assert image.file_sizes(folder) == named
        assert restored(folder / PAGES) == {page: content(one) for page, one in after.items()}
        changed = sum(newest.get(page) != number for page, number in after.items())
        if before and (len(after) - changed) * 8 >= len(after):
            assert sent == changed
            assert sizes.keys() == {f"{one}/{file_name(PID)}" for one in (PARENT, GRANDPARENT)}
        else:
            assert sent == len(after)


def test_the_format_is_that_of_criu():
    """A pagemap that CRIU wrote is written again as the same bytes."""
    found = Pagemap.decoded(SAMPLE)
    assert (found.file, [one.pages for one, _ in found.entries]) == (1, [1])
    assert found.encoded() == SAMPLE


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.replace(b"\x20\x04", b"\x20\x0c"),  # an unknown flag
        lambda data: data.replace(b"\x20\x04", b"\x38\x04"),  # an unknown field
        lambda data: data.replace(b"\x28\x01", b"\x28\x02"),  # more pages than the file has
        lambda data: data[:-1],
    ],
)
def test_a_dump_of_an_unknown_form_stays_as_it_is(tmp_path, change):
    """The whole dump can be sent then."""
    copy = dump_after_copy(tmp_path, {5: 1}, {5: 1})
    pagemap = tmp_path / PAGES / f"pagemap-{PID}.img"
    pagemap.write_bytes(change(pagemap.read_bytes()))
    before = {path.name: path.read_bytes() for path in (tmp_path / PAGES).iterdir()}
    with pytest.raises((ValueError, KeyError)):
        copied_pages.remove_copied_pages(tmp_path, copy, lambda: None)
    assert {path.name: path.read_bytes() for path in (tmp_path / PAGES).iterdir()} == before


def too_late() -> None:
    raise ValueError("it is too late")


def test_a_comparison_can_be_ended(tmp_path):
    """The whole dump can be sent then."""
    copy = dump_after_copy(tmp_path, FULL, FULL)
    before = {path.name: path.read_bytes() for path in (tmp_path / PAGES).iterdir()}
    with pytest.raises(ValueError, match="too late"):
        copied_pages.remove_copied_pages(tmp_path, copy, too_late)
    assert {path.name: path.read_bytes() for path in (tmp_path / PAGES).iterdir()} == before


def test_copies_that_the_dump_does_not_use_stay_out_of_the_image(tmp_path):
    """A small child has no copied pages; another child has ended before the dump."""
    copy = dump_after_copy(tmp_path, FULL, FULL)
    images = tmp_path / PAGES
    for small in ("pagemap-8.img", "pages-2.img"):
        (images / small).write_bytes(b"of a small child")
    for pid, pages in ((8, 0), (9, 1)):
        write_pages(copy.directory / file_name(pid), dict.fromkeys(range(pages), 1))
    ranges = {**copy.ranges, 8: [], 9: ranges_of({0: 1})}
    found = MemoryCopy(copy.directory, ranges)
    sizes = copied_pages.remove_copied_pages(tmp_path, found, lambda: None)
    named = {**image.file_sizes(tmp_path), **sizes}
    copied_pages.move_into_parent(tmp_path, copy.directory)
    assert image.file_sizes(tmp_path) == named


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


def test_a_copy_can_be_ended(tmp_path, holder):
    """A process with much memory on a slow disk does not hold up its move."""
    assert holder.stdout.readline()
    with pytest.raises(ValueError, match="too late"):
        memory_copy.copy([holder.pid], tmp_path / "copy", too_late)
