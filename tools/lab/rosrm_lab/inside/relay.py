"""Relay of a command on a virtual host for processes outside: signals in, exit status out.

Executed within the host's namespaces, but as a process of the machine: its child is the first
process of the host. The child receives signals of the terminal directly; the relay passes on
signals that a process sends to it. SIGKILL to the relay ends the child, too. Standard library only.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
from typing import Any

#: Signals that are passed on. Not SIGTSTP, which stops this process, as a shell expects.
PASSED = frozenset(
    {
        signal.SIGHUP,
        signal.SIGINT,
        signal.SIGQUIT,
        signal.SIGTERM,
        signal.SIGUSR1,
        signal.SIGUSR2,
        signal.SIGALRM,
        signal.SIGWINCH,
    }
)
#: Exit statuses as in shells.
NOT_FOUND = 127
NOT_EXECUTABLE = 126
NO_HOST = 125


def main() -> None:
    """Start the command, relay signals, and end with its exit status."""
    order = json.loads(sys.argv[1])
    command = sys.argv[2:]
    os.chdir(order["directory"] if os.path.isdir(order["directory"]) else order["data"])
    check(command[0], order["host"])
    before = signal.pthread_sigmask(signal.SIG_BLOCK, PASSED | {signal.SIGCHLD})
    child = fork(order["host"])
    if child == 0:
        become(order, command, before)
    for door in order["doors"]:
        os.close(door)
    end_like(relay(child))


def check(program: str, host: str) -> None:
    """Exit with a message that names the host, where there is no such program."""
    if shutil.which(program) is not None:
        return
    there = os.path.exists(program) and "/" in program
    why = "cannot be executed" if there else "no such command"
    print(f"rosrm: on {host}: {program}: {why}", file=sys.stderr)
    sys.exit(NOT_EXECUTABLE if there else NOT_FOUND)


def fork(host: str) -> int:
    """Fork as `os.fork`; exit where the host is just ending, and the kernel refuses a process."""
    try:
        return os.fork()
    except OSError as error:
        print(f"rosrm: {host} has gone: {error.strerror}", file=sys.stderr)
        sys.exit(NO_HOST)


def become(order: dict[str, Any], command: list[str], mask: set[int]) -> None:
    """Enter the control groups, and execute the command; called in the child."""
    try:
        for door in order["doors"]:
            os.write(door, b"0")
            os.close(door)
    except OSError as error:
        print(f"rosrm: {order['host']} has gone: {error.strerror}", file=sys.stderr)
        os._exit(NO_HOST)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # ignored by Python, not by other programs
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    words = ["setpriv", "--pdeathsig", "KILL", *order["identity"], "--", *command]
    os.execvp(words[0], words)  # noqa: S606 - no shell is wanted


def relay(child: int) -> int:
    """Pass signals on until the child has ended; return its wait status."""
    while True:
        received = signal.sigwaitinfo(PASSED | {signal.SIGCHLD})
        if received.si_signo != signal.SIGCHLD:
            if (
                received.si_code <= 0
            ):  # sent by a process; the child received the kernel's own as well
                os.kill(child, received.si_signo)
            continue
        while True:  # one signal may announce several changes
            pid, status = os.waitpid(child, os.WNOHANG | os.WUNTRACED)
            if not pid:
                break
            if not os.WIFSTOPPED(status):
                return status
            os.kill(os.getpid(), signal.SIGSTOP)
            os.kill(child, signal.SIGCONT)


def end_like(status: int) -> None:
    """Exit with the same code, or by the same signal."""
    if os.WIFEXITED(status):
        os._exit(os.WEXITSTATUS(status))
    number = os.WTERMSIG(status)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if number != signal.SIGKILL:
        signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
    os.kill(os.getpid(), number)


if __name__ == "__main__":
    main()
