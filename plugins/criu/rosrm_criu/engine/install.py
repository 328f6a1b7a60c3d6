"""`rosrm criu install`: installation of a working CRIU in a private prefix.

    PREFIX/bin/criu         a link into the tree in use; changed last, atomically
    PREFIX/trees/VERSION.X/ unpacked packages; the program is patched to load the C library and
                            all other libraries from there: a real binary, which can be given
                            capabilities (a wrapper cannot)
    PREFIX/packages/        the package files: a second installation needs no network
    PREFIX/fetching.X/      exists while packages are fetched

The installation changes nothing in the system and needs no root.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from rosrm.errors import CriuError
from rosrm.runtime.disk_space import room_for
from rosrm_criu.engine import packages as debian
from rosrm_criu.engine.binary import OLDEST, PROGRAM, Criu, opened
from rosrm_criu.engine.packages import Say

#: Packages to fetch; `patchelf` changes the library paths in the program `criu`.
_WANTED: Final = ("criu", "patchelf")
#: Bytes that an installation needs at most: packages, package lists and the tree.
_ROOM: Final = 160 << 20

BUILD_IT: Final = (
    "CRIU {oldest} or newer can be built from its source, too: docs/how-to/criu.md has the steps; "
    "then set ROSRM_CRIU to the program"
).format(oldest=".".join(map(str, OLDEST)))


def install(
    prefix: Path, say: Say, *, given: Path | None = None, mirrors: Sequence[str] = ()
) -> Criu:
    """Install CRIU into a prefix, unless a working one is there and no packages are given.

    The existing CRIU stays in use until the new one has answered.

    Args:
        prefix: created if it is missing.
        say: receives a line about each step.
        given: a package file, or a folder of them, instead of the archive's packages. If the C
            library is not among them, the system's libraries are used.
        mirrors: mirrors of the distribution's archive, instead of those in the system's sources.

    Raises:
        CriuError: the installation failed; the message says why, and what to do.
    """
    prefix = prefix.absolute()
    _check_name(prefix)
    with _prepared(prefix):
        present = None if given else _present(prefix)
        if present is not None:
            say(f"CRIU {present.version} is there already")
            return present
        files = _given(given) if given else _kept(prefix) or _fetched(prefix, say, mirrors)
        return _installed(prefix, files, say)


def _installed(prefix: Path, files: Sequence[Path], say: Say) -> Criu:
    """Unpack packages into a new tree, test the program, and only then switch to it."""
    versions = dict(map(debian.version_of, files))
    if "criu" not in versions:
        raise CriuError(f"no package `criu` among {len(files)} files: {', '.join(versions)}")
    trees = prefix / "trees"
    trees.mkdir(exist_ok=True)
    tree = Path(tempfile.mkdtemp(prefix=f"{versions['criu']}.", dir=trees))
    say(f"unpacking {len(files)} packages into {tree}")
    try:
        tree.chmod(0o755)
        debian.unpack(files, tree)
        program = bound(tree)
        criu = _new_enough(opened(program))
        _keep(prefix, files)
        _use(prefix / PROGRAM, program)
    except BaseException:
        shutil.rmtree(tree, ignore_errors=True)
        raise
    for other in trees.iterdir():
        if other != tree:
            shutil.rmtree(other, ignore_errors=True)
    return Criu((str(prefix / PROGRAM),), criu.version)


def _new_enough(criu: Criu) -> Criu:
    """Return a CRIU of a supported version; raise `CriuError` for an older one."""
    if criu.number < OLDEST:
        raise CriuError(
            f"this is CRIU {criu.version}; rosrm needs {'.'.join(map(str, OLDEST))} or newer, as "
            f"older ones cannot dump a ROS node. {BUILD_IT}"
        )
    return criu


def bound(tree: Path) -> Path:
    """Return the program of an unpacked tree, patched to use the tree's own libraries.

    A tree without a C library stays unchanged: its packages were built for this system.

    Raises:
        CriuError: there is no program, or it cannot be patched.
    """
    program = tree / "usr/sbin/criu"
    if not program.is_file():
        raise CriuError("the package has no usr/sbin/criu in it: this is not Debian's `criu`")
    # Packages older than Debian 13 also have libraries outside /usr.
    folders = [*tree.glob("usr/lib/*-linux-*"), *tree.glob("lib/*-linux-*")]
    loader = next((file for folder in folders for file in folder.glob("ld-linux*.so.*")), None)
    if loader is None:
        return program
    libraries = ":".join(map(str, folders))
    changer = tree / "usr/bin/patchelf"
    if not changer.is_file():
        raise CriuError("the packages bring a C library but no `patchelf` to use it with")
    # patchelf sets DT_RUNPATH by default; only DT_RPATH also applies to the libraries' libraries.
    debian.output_of(
        *(loader, "--library-path", libraries, changer, "--set-interpreter", loader),
        *("--force-rpath", "--set-rpath", libraries, program),
    )
    return program


# --- the prefix -------------------------------------------------------------------------------


def _check_name(prefix: Path) -> None:
    """Raise `CriuError` if the dynamic linker or apt would misread a character of the prefix."""
    bad = sorted(set(str(prefix)) & set(':;$"\\\n'))
    if bad:
        raise CriuError(
            f"the prefix {str(prefix)!r} cannot be used: the dynamic linker does not take "
            f"{' '.join(map(repr, bad))} in a path. Name another one: --prefix"
        )


def _present(prefix: Path) -> Criu | None:
    """Return the CRIU in this prefix; None: there is none that answers and is supported."""
    try:
        return _new_enough(opened(prefix / PROGRAM))
    except CriuError:
        return None


@contextlib.contextmanager
def _prepared(prefix: Path) -> Iterator[None]:
    """Lock the prefix, check the free space, and remove the rest of a killed installation."""
    try:
        prefix.mkdir(parents=True, exist_ok=True)
        lock = (prefix / "lock").open("a")
    except OSError as error:
        raise CriuError(
            f"the prefix {prefix} cannot be used: {error.strerror}. Name another one: --prefix"
        ) from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CriuError(f"another installation into {prefix} is under way") from None
        for left in prefix.glob("fetching.*"):
            shutil.rmtree(left, ignore_errors=True)
        if shutil.disk_usage(prefix).free < _ROOM:
            raise CriuError(
                f"CRIU needs {_ROOM >> 20} MiB in {prefix}, but {room_for(prefix / 'lock')}. "
                "Make room, or name another prefix: --prefix"
            )
        try:
            yield
        except OSError as error:
            full = error.errno in {errno.ENOSPC, errno.EDQUOT}
            raise CriuError(
                f"the prefix {prefix} cannot be written: {error.strerror}"
                + (f" ({room_for(prefix / 'lock')})" if full else "")
            ) from None


def _given(place: Path) -> list[Path]:
    """Return the package files that the user named; raise `CriuError` if there are none."""
    found = sorted(place.glob("*.deb")) if place.is_dir() else [place]
    if not found or not found[0].is_file():
        raise CriuError(f"{place}: no such package file, and no folder with *.deb files")
    return found


def _kept(prefix: Path) -> list[Path]:
    """Return the packages of an earlier installation."""
    return sorted((prefix / "packages").glob("*.deb"))


def _fetched(prefix: Path, say: Say, mirrors: Sequence[str]) -> list[Path]:
    """Fetch packages from the distribution's archive into the prefix, and return them."""
    with tempfile.TemporaryDirectory(prefix="fetching.", dir=prefix) as place:
        try:
            files = debian.fetch(_WANTED, debian.archive_here(), Path(place), say, mirrors=mirrors)
        except CriuError as error:
            raise CriuError(
                f"CRIU's packages could not be fetched: {error}. Packages that were fetched "
                f"elsewhere (PREFIX/packages there) install by --from FOLDER. {BUILD_IT}"
            ) from None
        _keep(prefix, files)
    return _kept(prefix)


def _keep(prefix: Path, files: Sequence[Path]) -> None:
    """Store these files as the prefix's packages."""
    kept = prefix / "packages"
    if files[0].parent.resolve() == kept.resolve():
        return
    with tempfile.TemporaryDirectory(prefix="fetching.", dir=prefix) as place:
        new = Path(place, "packages")
        new.mkdir()
        for file in files:
            shutil.copy(file, new)
        shutil.rmtree(kept, ignore_errors=True)
        new.rename(kept)


def _use(link: Path, program: Path) -> None:
    """Point the link to this program, atomically."""
    link.parent.mkdir(exist_ok=True)
    new = link.with_name("criu.new")
    new.unlink(missing_ok=True)
    new.symlink_to(os.path.relpath(program, link.parent))
    new.replace(link)
