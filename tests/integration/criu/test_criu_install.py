"""Installation of CRIU into a prefix: from local packages, bad packages, and interrupted."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine import packages
from rosrm_criu.engine.binary import opened
from rosrm_criu.engine.install import install
from rosrm_criu.engine.probe import probe


def quiet(step: str) -> None:
    pass


@pytest.fixture(scope="module")
def installed(cached, tmp_path_factory) -> Path:
    """Return a prefix with CRIU, for tests that leave a working one there, even another one."""
    prefix = tmp_path_factory.mktemp("criu")
    install(prefix, quiet, given=cached)
    return prefix


def test_what_is_installed_works(installed, criu):
    able = probe(opened(installed / "bin/criu"))
    assert (able.works, able.reason) == (True, "")


def test_it_needs_nothing_outside_its_prefix_but_the_kernel(installed):
    """The installed CRIU does not load even the system's C library, which may be older."""
    program = installed / "bin/criu"
    used = subprocess.run(
        [program, "--version"],
        env={"LD_DEBUG": "libs"},
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    loaded = [line.split()[-1] for line in used.splitlines() if "calling init:" in line]
    assert len(loaded) > 10
    assert [path for path in loaded if not path.startswith(str(installed.resolve()))] == []


def test_a_second_installation_changes_nothing(installed):
    before = (installed / "bin/criu").readlink()
    said: list[str] = []
    assert install(installed, said.append).command == (str(installed / "bin/criu"),)
    assert (installed / "bin/criu").readlink() == before
    assert len(said) == 1
    assert said[0].endswith(" is there already")


def test_a_broken_one_is_made_anew_from_the_packages_that_were_kept(installed):
    """A broken installation is repaired from the stored packages, without a reachable mirror."""
    (installed / "bin/criu").resolve().unlink()
    assert install(installed, quiet, mirrors=["http://127.0.0.1:9/none"]).version
    assert len(list((installed / "trees").iterdir())) == 1


def test_a_user_without_rights_installs_it(cached, as_nobody, public):
    code = (
        "import sys; from pathlib import Path; from rosrm_criu.engine.install import install\n"
        "print(*install(Path(sys.argv[1]), lambda step: None, given=Path(sys.argv[2])).command)"
    )
    done = as_nobody("-c", code, public / "prefix", cached, home=public)
    assert (done.stderr, done.stdout) == ("", f"{public}/prefix/bin/criu\n")
    assert opened(public / "prefix/bin/criu").version


def test_one_that_works_already_is_enough(criu, tmp_path, monkeypatch):
    monkeypatch.setenv("ROSRM_CRIU", criu.command[0])
    done = rosrm("criu", "install", "--prefix", tmp_path / "p")
    assert done.stdout.endswith(" works here: " + criu.command[0] + "; nothing to install\n")
    assert not (tmp_path / "p").exists()


def test_killed_in_between_the_old_one_is_in_use_and_the_next_one_clears_up(cached, installed):
    before = (installed / "bin/criu").readlink()
    words = ["criu", "install", "--prefix", installed, "--from", cached]
    new = subprocess.Popen([sys.executable, "-m", "rosrm.cli", *words], stdout=subprocess.PIPE)
    try:
        until = time.monotonic() + 60
        while len(list((installed / "trees").iterdir())) < 2:
            assert time.monotonic() < until, "no second tree within 60 s"
    finally:
        new.kill()
        new.communicate()
    assert (installed / "bin/criu").readlink() == before
    assert opened(installed / "bin/criu").version
    install(installed, quiet, given=cached)
    assert len(list((installed / "trees").iterdir())) == 1


@pytest.mark.slow  # the packages are downloaded once
def test_one_that_is_too_old_is_refused_and_the_present_one_stays(installed, older):
    kept = sorted(path.name for path in (installed / "packages").iterdir())
    with pytest.raises(CriuError, match=r"^this is CRIU 4\.1.*rosrm needs 4\.2 or newer"):
        install(installed, quiet, given=older("trixie") / "packages")
    assert opened(installed / "bin/criu").number >= (4, 2)
    assert sorted(path.name for path in (installed / "packages").iterdir()) == kept
    assert len(list((installed / "trees").iterdir())) == 1


# --- obstacles ---------------------------------------------------------------------------------


@pytest.fixture
def archive():
    """Return the archive of this system, or skip the test if it has none that is supported."""
    if shutil.which("apt-get") is None:
        pytest.skip("no apt here")
    try:
        return packages.archive_here()
    except CriuError as error:
        pytest.skip(str(error))


def test_without_network_it_says_so_and_leaves_nothing(archive, tmp_path):
    with pytest.raises(CriuError) as raised:
        install(tmp_path, quiet, mirrors=["http://127.0.0.1:9/none"])
    assert str(raised.value).startswith("CRIU's packages could not be fetched: apt-get: ")
    assert "127.0.0.1" in str(raised.value)
    assert "--from FOLDER" in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


def test_a_mirror_that_the_distribution_has_not_signed_is_not_used(archive, tmp_path):
    fake = tmp_path / "mirror/dists" / archive.suite
    (fake / "main/binary-amd64").mkdir(parents=True)
    (fake / "main/binary-amd64/Packages").write_text("Package: criu\nVersion: 9.9\n")
    (fake / "Release").write_text(f"Origin: Debian\nSuite: {archive.suite}\nComponents: main\n")
    with pytest.raises(CriuError, match="is not signed"):
        install(tmp_path / "p", quiet, mirrors=[f"file:{tmp_path}/mirror"])


def test_without_apt_it_says_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(packages, "archive_here", lambda: packages.Archive("s", "c", tmp_path))
    monkeypatch.setattr(Path, "is_file", lambda path: True)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CriuError, match=r"the command 'dpkg' is missing\. .* can be built"):
        install(tmp_path, quiet)


def test_on_another_distribution_it_says_so(tmp_path, monkeypatch):
    system = {"ID": "fedora", "PRETTY_NAME": "Fedora Linux 44"}
    monkeypatch.setattr("platform.freedesktop_os_release", lambda: system)
    with pytest.raises(CriuError, match=r"no packages for Fedora Linux 44\. .* can be built"):
        install(tmp_path, quiet)


@pytest.mark.parametrize("make", ["nothing", "empty", "damaged", "other"])
def test_bad_packages_are_named(make, cached, tmp_path):
    place = tmp_path / "packages"
    if make != "nothing":
        place.mkdir()
    if make == "damaged":
        (place / "criu_4.2_amd64.deb").write_bytes(b"!<arch>\nno package\n")
    if make == "other":
        shutil.copy(next(cached.glob("libmd0*.deb")), place)
    expected = {
        "nothing": "no such package file, and no folder",
        "empty": "no such package file, and no folder",
        "damaged": "criu_4.2_amd64.deb",
        "other": r"no package `criu` among 1 files: libmd0",
    }
    with pytest.raises(CriuError, match=expected[make]):
        install(tmp_path / "p", quiet, given=place)
    assert not (tmp_path / "p/bin/criu").exists()


def test_two_at_a_time_are_one_too_many(cached, tmp_path):
    with (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(CriuError, match=r"another installation into .* is under way"):
            install(tmp_path, quiet, given=cached)


@pytest.mark.parametrize("name", ["a:b", "a;b", 'a"b', "a$b"])
def test_a_prefix_that_the_dynamic_linker_cannot_read_is_refused(name, tmp_path):
    with pytest.raises(CriuError, match="the dynamic linker does not take"):
        install(tmp_path / name, quiet)
    assert not (tmp_path / name).exists()


def test_a_prefix_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CriuError, match=r"/file/p cannot be used: Not a directory\. Name another"):
        install(tmp_path / "file/p", quiet)


def test_a_full_disk_is_told_before_anything_is_fetched(tmp_path):
    if os.geteuid() != 0:
        pytest.skip("only root may mount a small file system")
    mounted = f'mount -t tmpfs -o size=4m none {tmp_path} && exec "$@"'
    words = [sys.executable, "-m", "rosrm.cli", "criu", "install", "--prefix", tmp_path / "p"]
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", mounted, "sh", *words],
        env={**os.environ, "ROSRM_CRIU": "/none"},
        capture_output=True,
        text=True,
        check=False,
    )
    if "unshare" in done.stderr or "mount:" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 1
    assert "CRIU needs 160 MiB in " in done.stderr
    assert f"the file system {tmp_path} has 4.0 MiB free of 4.0 MiB" in done.stderr


def rosrm(*words: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "rosrm.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=True)
