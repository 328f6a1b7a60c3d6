"""Explanations of the messages that CRIU 4.2.1 gave in trials."""

from __future__ import annotations

import re

import pytest

from rosrm_criu.engine import log_messages


@pytest.mark.parametrize(
    ("said", "meaning"),
    [
        ("Can't dump file 3 of that type [20600] (chr 10:229)", "is the device 10:229"),
        ("Can't dump file 3 of that type [600] (anon anon_inode:[userfaultfd])", "userfaultfd"),
        ("unix: External socket is used. Consider using --ext-unix-sk option.", "Unix socket"),
        ("Task 1 with SysVIPC shmem map @7f54 doesn't live in IPC ns", "System V shared memory"),
        ("sockets: BUG! Unknown socket collected (family 40)", "address family 40"),
        ("pidfd: pidfd pid 1 is not a part of process tree..", "a pidfd of the process 1"),
        ("Can't dump nested pid namespace for 14630", "a pid namespace of its own"),
        ("Can't lookup mount=43 for fd=1 path=/tmp/x.log;", "the file /tmp/x.log lies on a mount"),
        ("Can't write 4096 bytes: No space left on device", "the file system of the image is full"),
    ],
)  # fmt: skip
def test_why_it_could_not_be_dumped(said, meaning):
    """The explanation of a failed dump names the resource."""
    assert meaning in log_messages.of_dump(
        f"CRIU 4.2.1 could not dump: {said} (its log: /a/dump.log)"
    )


@pytest.mark.parametrize(
    ("said", "meaning"),
    [
        ("inet: Can't bind inet socket (id 15): Cannot assign requested address", "does not have"),
        ("inet: Can't bind inet socket (id 15): Address already in use", "port .* is in use here"),
        ("Can't fork for 4711: File exists", "its pid 4711 is in use here"),
        ("Can't open file home/a/x on restore: No such file or directory", "file /home/a/x cannot"),
        ("File home/a/x has bad size 3 (expect 4)", "/home/a/x has 3 bytes here; .* with 4"),
        ("unix: FATAL: Peer 1739708 unresolved for 1741185", "Unix socket"),
    ],
)
def test_why_it_could_not_be_restored(said, meaning):
    """The explanation of a failed restore names what this host lacks."""
    assert re.search(meaning, log_messages.of_restore(f"CRIU 4.2.1 could not restore: {said}"))


def test_what_is_not_in_the_table_is_passed_on():
    """An unknown message gets no explanation."""
    assert log_messages.of_dump("something new") == log_messages.of_restore("something new") == ""
