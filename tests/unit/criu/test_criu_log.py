"""Causes of failures in CRIU's logs, and their explanations."""

from __future__ import annotations

import re

import pytest

from rosrm_criu.engine.criu_log import causes, explain_dump, explain_restore, first_words

SOCKET = """\
(00.000074) Version: 4.2.1 (gitid 0)
(00.000090) Running on a Linux 6.18.44
Error (criu/util.c:1534): rlimit: Can't setup RLIMIT_NOFILE for self: Operation not permitted
Warn  (compel/arch/x86/src/lib/infect.c:419): Will restore 12012 with interrupted system call
(00.004711) Error (criu/sk-unix.c:874): unix: External socket is used. Consider using --ext-unix-sk
(00.004811) Error (criu/cr-dump.c:1975): Dumping FAILED.
"""
RESTORE = """\
(00.01)  12012: Error (criu/sk-inet.c:1057): inet: Can't bind inet socket (id 5): Cannot assign it
(00.02)  12012: Error (criu/files.c:1217): Unable to open fd=3 id=0x5
(00.02)  12012: Error (criu/files.c:1217): Unable to open fd=3 id=0x5
(00.03) Error (criu/cr-restore.c:1536): 12012 exited, status=1
(00.04) Error (criu/cr-restore.c:2613): Restoring FAILED.
"""
#: In this output, the lines of child processes are indented.
WITHOUT_TIMES = """\
Error (criu/util.c:1534): rlimit: Can't setup RLIMIT_NOFILE for self: Operation not permitted
  1189: Error (criu/sk-inet.c:1059): inet: Can't bind inet socket: in use
"""


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        (SOCKET, ("unix: External socket is used. Consider using --ext-unix-sk",)),
        (
            RESTORE,
            (
                "inet: Can't bind inet socket (id 5): Cannot assign it",
                "Unable to open fd=3 id=0x5",
            ),
        ),
        (WITHOUT_TIMES, ("inet: Can't bind inet socket: in use",)),
        ("Error (criu/cr-restore.c:99): exited, status=1\n" * 2, ("exited, status=1",)),
        (
            "".join(f"(00.1) Error (a.c:{n}): cause {n}\n" for n in range(20)),
            ("cause 0", "cause 1", "cause 2"),
        ),
        ("(00.1) Looks good.\nWarn (a.c:1): Error is a word\n", ()),
        ("", ()),
    ],
    ids=["socket", "restore", "without-times", "nothing-better", "many", "no-error", "empty"],
)
def test_the_first_three_causes_are_named_once_without_general_lines(log, expected):
    assert causes(log) == expected


def test_without_an_error_the_first_line_is_taken():
    said = (
        "Warn  (criu/kerndat.c:1200): $XDG_RUNTIME_DIR not set.\n"
        "CRIU needs to have the CAP_SYS_ADMIN or the CAP_CHECKPOINT_RESTORE capability: \n"
        "setcap cap_checkpoint_restore+eip criu\n"
    )
    wanted = "CRIU needs to have the CAP_SYS_ADMIN or the CAP_CHECKPOINT_RESTORE capability"
    assert (causes(said), first_words(said)) == ((), (wanted,))


# --- explanations of messages that CRIU 4.2.1 gave in trials ---------------------------------


DUMP = [
    ("Can't dump file 3 of that type [20600] (chr 10:229)", "is the device 10:229"),
    ("Can't dump file 3 of that type [600] (anon anon_inode:[userfaultfd])", "userfaultfd"),
    ("unix: External socket is used. Consider using --ext-unix-sk option.", "Unix socket"),
    ("Task 1 with SysVIPC shmem map @7f54 doesn't live in IPC ns", "System V shared memory"),
    ("sockets: BUG! Unknown socket collected (family 40)", "address family 40"),
    ("pidfd: pidfd pid 1 is not a part of process tree..", "a pidfd of the process 1"),
    ("Can't dump nested pid namespace for 14630", "a pid namespace of its own"),
    ("Can't lookup mount=43 for fd=1 path=/tmp/x.log;", "the file /tmp/x.log lies on a mount"),
    ("Can't write 4096 bytes: No space left on device", "the file system of the image is full"),
]  # fmt: skip
RESTORE_FAULTS = [
    ("inet: Can't bind inet socket (id 15): Cannot assign requested address", "does not have"),
    ("inet: Can't bind inet socket (id 15): Address already in use", "port .* is in use here"),
    ("Can't fork for 4711: File exists", "its pid 4711 is in use here"),
    ("Can't open file home/a/x on restore: No such file or directory", "file /home/a/x cannot"),
    ("File home/a/x has bad size 3 (expect 4)", "/home/a/x has 3 bytes here; .* with 4"),
    ("unix: FATAL: Peer 1739708 unresolved for 1741185", "Unix socket"),
]


@pytest.mark.parametrize(
    ("explain", "message", "meaning"),
    [
        *((explain_dump, *row) for row in DUMP),
        *((explain_restore, *row) for row in RESTORE_FAULTS),
    ],
)
def test_a_known_message_is_explained(explain, message, meaning):
    """The explanation names the resource, or what this host lacks."""
    assert re.search(meaning, explain(f"CRIU 4.2.1 failed: {message} (its log: /a/x.log)"))


def test_an_unknown_message_has_no_explanation():
    """The message itself is passed on."""
    assert explain_dump("something new") == explain_restore("something new") == ""
