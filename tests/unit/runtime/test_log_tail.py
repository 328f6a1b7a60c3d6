"""The last lines of a log of any content or length, or of a missing log."""

from __future__ import annotations

from rosrm.runtime.log_tail import last_lines


def test_bytes_that_are_no_text_are_replaced(tmp_path):
    """A program may write any bytes into its log."""
    log = tmp_path / "a.log"
    log.write_bytes(b"one\n\xff\xfe two\n")
    assert last_lines(log) == ["one", "\N{REPLACEMENT CHARACTER}" * 2 + " two"]


def test_only_the_end_of_a_long_log_is_read(tmp_path):
    """A log of gigabytes costs 64 KiB of memory."""
    log = tmp_path / "a.log"
    log.write_bytes(b"x" * (1 << 20) + b"\nlast\n")
    *rest, last = last_lines(log)
    assert last == "last"
    assert sum(map(len, rest)) < 1 << 16


def test_a_log_that_cannot_be_read_has_its_reason_as_its_line(tmp_path):
    """If the log is missing or a directory, the reason takes the place of the lines."""
    assert last_lines(tmp_path / "none") == [
        "(the log cannot be read: No such file or directory)"
    ]  # fmt: skip
    assert last_lines(tmp_path) == ["(the log cannot be read: Is a directory)"]
