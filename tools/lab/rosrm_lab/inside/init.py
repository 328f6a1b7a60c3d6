"""The first process of a virtual host: it sets up the host, then reaps orphans.

Executed in new namespaces; its first child is PID 1 there. It writes to a pipe "pid N" (as seen
from outside), then "ready" or "failed WHY". Standard library only.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys

DATA = "/run/data"
FOLDERS = ("state", "tmp", "ros")


def main() -> None:
    """Become PID 1 of the namespaces in which this process was started."""
    settings = json.loads(sys.argv[1])
    ready = int(settings["ready"])
    child = os.fork()
    if child:
        os.write(ready, f"pid {child}\n".encode())
        os._exit(0)
    os.setsid()
    try:
        set_up(settings)
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip()
        os.write(ready, f"failed {' '.join(error.cmd)}: {said}\n".encode())
        os._exit(1)
    except OSError as error:
        os.write(ready, f"failed {error}\n".encode())
        os._exit(1)
    os.write(ready, b"ready\n")
    os.close(ready)
    release_files()
    reap()


def set_up(settings: dict[str, str]) -> None:
    """Set the name and the mounts of the host."""
    socket.sethostname(settings["hostname"])
    mount("-t", "proc", "-o", "nosuid,nodev,noexec", "proc", "/proc")
    mount("-t", "tmpfs", "-o", "mode=755,nosuid,nodev", "tmpfs", "/run")
    own_sysfs()
    shared = ",".join(["mode=1777,nosuid,nodev", *settings["shm_options"].split()])
    mount("-t", "tmpfs", "-o", shared, "tmpfs", "/dev/shm")  # noqa: S108 - a mount point
    if os.path.isdir("/dev/mqueue"):
        mount("-t", "mqueue", "mqueue", "/dev/mqueue")
    own_data(settings["image"])
    own_hosts_file(settings["hosts_file"])


def own_sysfs() -> None:
    """Mount a sysfs with the host's own network interfaces, and the machine's control groups."""
    kept = "/run/cgroup"
    os.mkdir(kept)
    mount("--rbind", "/sys/fs/cgroup", kept)
    mount("-t", "sysfs", "-o", "nosuid,nodev,noexec", "sysfs", "/sys")
    mount("--move", kept, "/sys/fs/cgroup")
    os.rmdir(kept)


def own_data(image: str) -> None:
    """Mount the host's disk, writable for every user on the host."""
    os.mkdir(DATA)
    mount("-o", "loop,noatime", image, DATA)
    os.chmod(DATA, 0o1777)  # noqa: S103 - as /tmp
    for folder in FOLDERS:
        path = os.path.join(DATA, folder)
        os.makedirs(path, exist_ok=True)
        os.chmod(path, 0o1777)  # noqa: S103 - as /tmp


def own_hosts_file(content: str) -> None:
    """Mount an /etc/hosts with the names of all hosts."""
    if os.path.isfile("/etc/hosts"):
        with open("/run/hosts", "w", encoding="ascii") as file:
            file.write(content)
        mount("--bind", "/run/hosts", "/etc/hosts")


def mount(*words: str) -> None:
    """Run `mount`; raises `CalledProcessError`."""
    subprocess.run(["mount", *words], check=True, capture_output=True)


def release_files() -> None:
    """Release the terminal, the directory and the files of the process that made this host."""
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    os.close(null)


def reap() -> None:
    """Wait for the orphans of this host, for ever; only SIGKILL from outside ends PID 1."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD})
    while True:
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                continue
        except ChildProcessError:
            pass  # there are no children at the moment
        signal.sigwait({signal.SIGCHLD})


if __name__ == "__main__":
    main()
