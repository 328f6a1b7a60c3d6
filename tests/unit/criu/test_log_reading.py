"""Extraction of causes from CRIU's logs."""

from __future__ import annotations

import pytest

from rosrm_criu.engine.log_reader import causes, first_words

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
        ("(00.1) Looks good.\nWarn (a.c:1): Error is a word\n", ()),
        ("", ()),
    ],
    ids=["socket", "restore", "without-times", "nothing-better", "no-error", "empty"],
)
def test_the_first_causes_are_told_once_and_without_what_every_failure_says(log, expected):
    assert causes(log) == expected


def test_no_more_lines_than_fit_a_sentence():
    log = "".join(f"(00.1) Error (a.c:{n}): cause {n}\n" for n in range(20))
    assert causes(log) == ("cause 0", "cause 1", "cause 2")


def test_where_nothing_is_called_an_error_its_first_words_are_taken():
    said = (
        "Warn  (criu/kerndat.c:1200): $XDG_RUNTIME_DIR not set.\n"
        "CRIU needs to have the CAP_SYS_ADMIN or the CAP_CHECKPOINT_RESTORE capability: \n"
        "setcap cap_checkpoint_restore+eip criu\n"
    )
    wanted = "CRIU needs to have the CAP_SYS_ADMIN or the CAP_CHECKPOINT_RESTORE capability"
    assert (causes(said), first_words(said)) == ((), (wanted,))
