"""Program of another local user: tries to use a cluster, and prints what succeeded as JSON.

Its interpreter may be readable by root alone. So it imports all modules as root, and gives up its
rights before it tries anything.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Final

from rosrm.errors import RosrmError
from rosrm.keys import key_files
from rosrm.keys.finding import user_security
from rosrm.keys.roles import principal_of
from rosrm.keys.security import NoSecurity
from rosrm.ros import convert, names
from rosrm.ros.orders import order_to_msg
from rosrm.testing.loopback import settings_on_this_machine
from rosrm_msgs import srv
from tests.faults.intruder import (
    MASTER_SERVICES,
    Intruder,
    false_master,
    false_member,
    path,
    public_key,
)
from tests.faults.intruder_scene import HOSTS, order_of_theft, theft

NOBODY: Final = 65534


def files_of(roots: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return the files and the sockets in directory trees."""
    found = [path for root in roots for path in root.rglob("*")]
    return [one for one in found if one.is_file()], [one for one in found if one.is_socket()]


def opened(files: list[Path], sockets: list[Path]) -> Iterator[str]:
    """Yield the files that can be read or changed, and the sockets that accept."""
    for file in files:
        for mode in ("rb", "r+b"):
            with suppress(OSError), file.open(mode):
                yield f"{file} {mode}"
    for one in sockets:
        with suppress(OSError), socket.socket(socket.AF_UNIX) as client:
            client.connect(str(one))
            yield str(one)


def used_keys(keys: str) -> Iterator[str]:
    """Yield the directories of keys with which this user could speak."""
    for home in ("/nowhere", keys):
        os.environ["ROSRM_KEYS"] = home
        with suppress(RosrmError):
            user_security("keys")
            yield home


def answered(intruder: Intruder, stolen: Path) -> Iterator[str]:
    """Yield the requests that were answered."""
    me = f"user:{key_files.user_name()}"
    for security in (false_member(me), false_member("user:root"), NoSecurity(principal_of(me))):
        intruder.wait_for_beat()
        for name, kind in MASTER_SERVICES.items():
            request = kind.Request()
            if kind is srv.Submit:
                request.processes = [convert.spec_to_msg(theft(stolen))]
            if intruder.answer(intruder.ask_master(security, name, request), 0.1) is not None:
                yield name
    for security in (false_master(), NoSecurity()):
        for host in HOSTS:
            peer = security.peer(f"host:{host}", 0)
            service, order = path.of_host(host, names.CONTROL), order_to_msg(order_of_theft(stolen))
            if intruder.answer(intruder.ask(security, service, peer, order), 0.1) is not None:
                yield service


def main(domain: str, directory: str, keys: str, pids: str) -> None:
    """Try everything against the cluster of a domain, with its state directory and its keys."""
    settings, key = settings_on_this_machine(int(domain)), public_key()
    with closing(Intruder(settings, *HOSTS, key=key)) as as_root:  # loads what ROS loads late
        as_root.wait_for_beat()
    here = [Path(keys), *(Path(directory) / part for part in ("master", "hosts"))]
    files, sockets = files_of(here)
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    files += [Path(f"/proc/{pid}/environ") for pid in pids.split(",")]
    with closing(Intruder(settings, *HOSTS, key=key)) as intruder:
        intruder.wait_for_beat()
        found = {
            "looked at": len(files) + len(sockets),
            "opened": list(opened(files, sockets)),
            "used": list(used_keys(keys)),
            "answered": list(answered(intruder, Path(directory) / "stolen")),
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
