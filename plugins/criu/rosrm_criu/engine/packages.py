"""Download of packages from a distribution's newest archive by apt, without changes to the system.

apt resolves the dependencies with its own lists, cache and an empty status file. Because nothing
counts as installed there, everything down to the C library is fetched. No root is needed. The
system's sources give the mirrors; packages must be signed by the distribution's own key.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.runtime.disk_space import room_for

#: Receives a line of progress for the user.
Say = Callable[[str], None]


@dataclass(frozen=True)
class Archive:
    """Names in a distribution's package archive.

    Args:
        suite: the one with the newest packages.
        components: the components that CRIU and its dependencies are in.
        keyring: file with the keys that sign the archive.
    """

    suite: str
    components: str
    keyring: Path


_KEYRINGS: Final = Path("/usr/share/keyrings")
#: By the ID in /etc/os-release. Both suites are permanent aliases of the newest release.
ARCHIVES: Final = {
    "debian": Archive("sid", "main", _KEYRINGS / "debian-archive-keyring.gpg"),
    "ubuntu": Archive("devel", "main universe", _KEYRINGS / "ubuntu-archive-keyring.gpg"),
}
#: Timeouts in seconds: for local commands, and for downloads.
_QUICK: Final = 60.0
_FETCH: Final = 900.0
#: Limit for systems with many third-party sources: no more mirrors than this are tried.
_MOST_MIRRORS: Final = 8

#: Configuration of apt. Run by root, apt would switch to its own user, who cannot write here.
_CONFIGURATION: Final = """\
#clear APT::Update::Pre-Invoke;
#clear APT::Update::Post-Invoke;
#clear APT::Update::Post-Invoke-Success;
#clear APT::Architectures;
APT::Architectures {{ "{architecture}"; }};
APT::Sandbox::User "root";
APT::Get::List-Cleanup "false";
Acquire::Languages "none";
Acquire::Retries "1";
Acquire::http::Timeout "20";
Acquire::https::Timeout "20";
Dir::Etc::sourcelist "{place}/archive.sources";
Dir::Etc::sourceparts "/dev/null";
Dir::Etc::preferences "/dev/null";
Dir::Etc::preferencesparts "/dev/null";
Dir::State "{place}/state";
Dir::State::status "{place}/status";
Dir::Cache "{place}/cache";
"""


def archive_here() -> Archive:
    """Return the archive of this distribution; raise `CriuError` for an unknown distribution."""
    try:
        system = platform.freedesktop_os_release()
    except OSError:
        system = {"ID": "unknown"}
    for name in (system["ID"], *system.get("ID_LIKE", "").split()):
        if name in ARCHIVES:
            return ARCHIVES[name]
    raise CriuError(f"there are no packages for {system.get('PRETTY_NAME', system['ID'])}")


def fetch(
    wanted: Sequence[str], archive: Archive, place: Path, say: Say, *, mirrors: Sequence[str] = ()
) -> list[Path]:
    """Fetch packages and their dependencies.

    Args:
        wanted: names of packages; `say` receives the version of the first one.
        archive: the archive to use.
        place: an empty folder for all files of apt; the packages stay in it.
        say: receives a line about each step.
        mirrors: mirrors of the archive, instead of those in the system's sources.

    Raises:
        CriuError: apt, a mirror, the network, disk space or a package is missing.
    """
    if not archive.keyring.is_file():
        raise CriuError(f"the distribution's keys are missing: {archive.keyring}")
    apt = _Apt(place)
    failed = []
    for mirror in mirrors or _mirrors():
        say(f"asking {mirror} for the packages of {archive.suite} (about 12 MB)")
        apt.use(mirror, archive)
        try:
            apt.run(_FETCH, "apt-get", "update", "--error-on=any")
        except CriuError as error:
            failed.append(str(error))
            continue
        break
    else:
        raise CriuError("; ".join(failed))
    say(f"fetching {wanted[0]} {apt.candidate(wanted[0])} and what it needs (about 10 MB)")
    apt.run(
        _FETCH, "apt-get", "install", "--yes", "--download-only", "--no-install-recommends", *wanted
    )
    return sorted((place / "cache/archives").glob("*.deb"))


def unpack(packages: Sequence[Path], place: Path) -> None:
    """Unpack packages into a folder without running their scripts; raise `CriuError`."""
    for package in packages:
        _output(_QUICK, "dpkg-deb", "--extract", package, place, room=place)


def output_of(*words: str | Path) -> str:
    """Return the output of a short command; raise `CriuError` with its error message."""
    return _output(_QUICK, *words)


def version_of(package: Path) -> tuple[str, str]:
    """Return name and version of a package file; raise `CriuError` if it is no package."""
    said = _output(_QUICK, "dpkg-deb", "--show", "--showformat", "${Package} ${Version}", package)
    name, _, version = said.partition(" ")
    return name, version


class _Apt:
    """apt, restricted to one folder for all files that it writes."""

    def __init__(self, place: Path) -> None:
        self._place = place
        for folder in ("state/lists/partial", "cache/archives/partial"):
            (place / folder).mkdir(parents=True)
        (place / "status").touch()
        said = _CONFIGURATION.format(
            place=place,
            architecture=_output(_QUICK, "dpkg", "--print-architecture").strip(),
        )
        (place / "apt.conf").write_text(said, encoding="utf-8")

    def use(self, mirror: str, archive: Archive) -> None:
        """Use this mirror from now on."""
        (self._place / "archive.sources").write_text(
            f"Types: deb\nURIs: {mirror}\nSuites: {archive.suite}\n"
            f"Components: {archive.components}\nSigned-By: {archive.keyring}\n",
            encoding="utf-8",
        )

    def candidate(self, package: str) -> str:
        """Return the version that apt would fetch of a package; raise `CriuError` if none."""
        said = self.run(_QUICK, "apt-cache", "policy", package)
        version = re.search(r"^\s*Candidate:\s*(\S+)", said, re.MULTILINE)
        if version is None or version[1] == "(none)":
            raise CriuError(f"this archive has no package {package!r} for this machine")
        return version[1]

    def run(self, seconds: float, program: str, *arguments: str) -> str:
        """Run a program of apt and return its output; raise `CriuError` with its error message."""
        file = self._place / "apt.conf"
        return _output(seconds, program, "-c", file, *arguments, room=self._place)


def _mirrors() -> list[str]:
    """Return the mirrors in the system's sources, in their order; raise `CriuError` if none."""
    said = _output(_QUICK, "apt-get", "update", "--print-uris")
    found = re.findall(r"^'([^']+)/dists/[^']*/InRelease'", said, re.MULTILINE)
    mirrors = [uri for uri in dict.fromkeys(found) if not uri.startswith("cdrom:")]
    if not mirrors:
        raise CriuError("apt's sources name no mirror of the distribution (/etc/apt/sources.list*)")
    return mirrors[:_MOST_MIRRORS]


def _output(seconds: float, *words: str | Path, room: Path | None = None) -> str:
    """Return a program's output; raise `CriuError` with its error message and the free space."""
    try:
        done = subprocess.run(
            words,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=seconds,
            env={**os.environ, "LC_ALL": "C"},
            check=False,
        )
    except FileNotFoundError:
        raise CriuError(f"the command {words[0]!r} is missing") from None
    except subprocess.TimeoutExpired:
        raise CriuError(f"{words[0]} was not done within {seconds:g} s") from None
    if done.returncode == 0:
        return done.stdout
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    complaint = next((line for line in lines if "rror" in line or line.startswith("E: ")), "")
    said = complaint or (lines[-1] if lines else f"code {done.returncode}")
    full = f" ({room_for(room)})" if room and "No space left" in done.stderr else ""
    raise CriuError(f"{words[0]}: {said.removeprefix('E: ')}{full}")
