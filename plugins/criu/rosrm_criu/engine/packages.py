"""Packages of a distribution's newest archive, fetched by apt without touching the system.

apt resolves what they need, with lists, cache and a status file of its own, in which nothing is
installed: so everything down to the C library comes along. No root is needed. Where the archive is,
the system's own sources say; what is fetched has to be signed by the distribution's own key.
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

#: Takes a line that tells a person how far it is.
Say = Callable[[str], None]


@dataclass(frozen=True)
class Archive:
    """What a distribution calls its archive.

    Args:
        suite: the one with the newest packages.
        components: the parts of it that CRIU lies in.
        keyring: whose keys have signed it.
    """

    suite: str
    components: str
    keyring: Path


_KEYRINGS: Final = Path("/usr/share/keyrings")
#: By the ID of /etc/os-release. Both names stay: they are aliases for what is newest.
ARCHIVES: Final = {
    "debian": Archive("sid", "main", _KEYRINGS / "debian-archive-keyring.gpg"),
    "ubuntu": Archive("devel", "main universe", _KEYRINGS / "ubuntu-archive-keyring.gpg"),
}
#: Seconds: for what apt does by itself, and for what it fetches.
_QUICK: Final = 60.0
_FETCH: Final = 900.0
#: More mirrors than anybody has; a system with many third-party sources is not asked for all.
_MOST_MIRRORS: Final = 8

#: For apt. Its own user, to which it changes as root, cannot write into our folder.
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
    """The archive of this system's distribution; raises `CriuError` where it has none of ours."""
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
    """Fetch packages and all that they need.

    Args:
        wanted: names of packages; the first one's version is said.
        archive: which one.
        place: an empty folder for all that apt keeps; the packages stay in it.
        say: told of each step.
        mirrors: where the archive may be, instead of what the system's sources say.

    Raises:
        CriuError: there is no apt, mirror, network or room, or not these packages.
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
    """Lay the files of packages below a folder; nothing of them is run. Raises `CriuError`."""
    for package in packages:
        _output(_QUICK, "dpkg-deb", "--extract", package, place, room=place)


def output_of(*words: str | Path) -> str:
    """What a short command prints; raises `CriuError` with its complaint."""
    return _output(_QUICK, *words)


def version_of(package: Path) -> tuple[str, str]:
    """Name and version of a package file; raises `CriuError` where it is none."""
    said = _output(_QUICK, "dpkg-deb", "--show", "--showformat", "${Package} ${Version}", package)
    name, _, version = said.partition(" ")
    return name, version


class _Apt:
    """apt, with everything that it writes below one folder."""

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
        """Ask this mirror from now on."""
        (self._place / "archive.sources").write_text(
            f"Types: deb\nURIs: {mirror}\nSuites: {archive.suite}\n"
            f"Components: {archive.components}\nSigned-By: {archive.keyring}\n",
            encoding="utf-8",
        )

    def candidate(self, package: str) -> str:
        """The version of a package that would be fetched; raises `CriuError` if there is none."""
        said = self.run(_QUICK, "apt-cache", "policy", package)
        version = re.search(r"^\s*Candidate:\s*(\S+)", said, re.MULTILINE)
        if version is None or version[1] == "(none)":
            raise CriuError(f"this archive has no package {package!r} for this machine")
        return version[1]

    def run(self, seconds: float, program: str, *arguments: str) -> str:
        """Its output; raises `CriuError` with what it calls an error."""
        file = self._place / "apt.conf"
        return _output(seconds, program, "-c", file, *arguments, room=self._place)


def _mirrors() -> list[str]:
    """Where the system's own sources lead, the first ones first; raises `CriuError`."""
    said = _output(_QUICK, "apt-get", "update", "--print-uris")
    found = re.findall(r"^'([^']+)/dists/[^']*/InRelease'", said, re.MULTILINE)
    mirrors = [uri for uri in dict.fromkeys(found) if not uri.startswith("cdrom:")]
    if not mirrors:
        raise CriuError("apt's sources name no mirror of the distribution (/etc/apt/sources.list*)")
    return mirrors[:_MOST_MIRRORS]


def _output(seconds: float, *words: str | Path, room: Path | None = None) -> str:
    """What a program prints; raises `CriuError` with its complaint, and what room there is."""
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
