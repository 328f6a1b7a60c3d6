"""Report of `rosrm key check`: keys of this user, and what keys do not protect."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rosrm.config.first_name import default_host
from rosrm.errors import ConfigError
from rosrm.keys import key_files
from rosrm.keys.cluster import OWN, PrincipalKey, Principals
from rosrm.keys.roles import default_security
from rosrm.wording import counted

_NOT_PROTECTED: Final = (
    "topics and services of the applications",
    "names, sizes and times of rosrm's messages",
    "delivery: flooding and forged packets of DDS can delay messages",
)


@dataclass
class KeyReport:
    """Facts, and faults that the user should correct.

    Attributes:
        rows: label and text of each fact.
        faults: one sentence for each fault.
    """

    rows: list[tuple[str, str]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def add_fault(self, text: str) -> None:
        """Add a fault, unless the report has it."""
        if text not in self.faults:
            self.faults.append(text)


def file_report(home: Path, path: Path) -> KeyReport:
    """Return the report of one key file.

    Args:
        home: directory of this user's keys.
        path: of the file.

    Raises:
        ConfigError: the file is missing or invalid, or others can read it.
    """
    report = KeyReport()
    key = key_files.read_key(path)
    report.rows.append((path.name, f"{_described(key)}; only this user can read the file"))
    if key_files.read_secret(home) is None:
        report.rows.append(("valid", "unknown: only the machine of the master can check this"))
    else:
        _check_validity(report, home, key)
        report.rows.append(("valid", "no" if report.faults else "yes, in this user's cluster"))
    return report


def user_report(home: Path, host: str = "") -> KeyReport:
    """Return the report of all keys of this user.

    Args:
        home: directory of this user's keys.
        host: name of the slave's host; "": the machine's host name.
    """
    report = KeyReport()
    report.rows.append(("directory", str(home)))
    _check_mode(report, home)
    if default_security() == "none":
        report.rows.append(("security", "none (ROSRM_SECURITY): keys are not used"))
    has_secret = _check_files(report, home)
    found = [
        _report_part(report, home, "commands", "user", ""),
        _report_part(report, home, "slave", "host", host or default_host()),
    ]
    if not any(found) and not report.faults:
        report.add_fault(
            f"this user has no key. Copy a key file of `rosrm key add` to {home}; on the machine "
            f"of the master, `rosrm key init` or the first `rosrm master` makes cluster.key"
        )
    rights = "all rights in the cluster" if has_secret else "no rights but those of its keys"
    report.rows.append(("cluster.key", f"{'here' if has_secret else 'not here'}: {rights}"))
    report.rows += [("not protected", text) for text in _NOT_PROTECTED]
    return report


def _check_mode(report: KeyReport, home: Path) -> None:
    if home.exists() and home.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        report.add_fault(f"other users can replace files in {home}; run `chmod 700 {home}`")


def _check_files(report: KeyReport, home: Path) -> bool:
    """Report the files of the directory; return True if it has the cluster's secret."""
    paths = key_files.key_paths(home)
    private = 0
    for path in paths:
        try:
            key_files.read_key(path)
            private += 1
        except ConfigError as error:
            report.add_fault(str(error))
    if paths:
        count = counted(len(paths), "key file", "key files")
        report.rows.append(("files", f"{count}, {private} of them readable by this user alone"))
    has_secret = False
    try:
        has_secret = key_files.read_secret(home) is not None
        key_files.read_grants(home)
    except ConfigError as error:
        report.add_fault(str(error))
    return has_secret


def _report_part(report: KeyReport, home: Path, part: str, kind: str, name: str) -> bool:
    """Report the key of commands or of a slave; return True if there is one."""
    try:
        key = key_files.find_key(kind, name, home, os.environ.get("ROSRM_KEY", ""))
    except ConfigError as error:
        report.add_fault(str(error))
        return False
    if key is None:
        report.rows.append((part, "no key"))
        return False
    if key.grant.principal.kind != kind:
        report.rows.append((part, f"no key: ROSRM_KEY names that of {key.grant.principal}"))
        return False
    report.rows.append((part, _described(key)))
    _check_validity(report, home, key)
    return True


def _described(key: PrincipalKey) -> str:
    grant = key.grant
    source = "from cluster.key" if grant.generation == OWN else f"key {grant.generation}"
    return f"{grant.principal}, role {grant.role.value}, {source}"


def _check_validity(report: KeyReport, home: Path, key: PrincipalKey) -> None:
    """Report a key that this machine's cluster refuses, if this is the machine of the master."""
    try:
        secret = key_files.read_secret(home)
        if secret is None:
            return
        valid = Principals(key_files.read_grants(home))
    except ConfigError as error:
        report.add_fault(str(error))
        return
    grant = valid.valid_grant(key.grant.principal, key.grant.generation)
    if grant is None or secret.key_of(grant) != key:
        report.add_fault(
            f"the key of {key.grant.principal} is not valid in the cluster of this machine: it was "
            f"revoked or replaced, or is of another cluster"
        )
