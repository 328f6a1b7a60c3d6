"""Installation of CRIU in a folder by `scripts/install_criu.sh`."""

from __future__ import annotations

import fcntl
import shutil
import subprocess
from pathlib import Path

import pytest

from rosrm_criu.engine.binary import opened
from rosrm_criu.engine.probe import probe
from tests.integration.criu.conftest import SCRIPT, install_criu

#: A mirror that no server answers for.
UNREACHABLE = "http://127.0.0.1:9/none"


@pytest.fixture
def with_packages(cached, tmp_path) -> Path:
    """Return a folder with the package files of CRIU, as a user copies them to another host."""
    shutil.copytree(cached, tmp_path / "criu/packages")
    return tmp_path / "criu"


def test_the_installed_program_works_by_its_own_libraries(with_packages, criu):
    """The program loads not even the system's C library; later runs need no network."""
    done = install_criu(with_packages, MIRROR=UNREACHABLE)
    assert (done.returncode, done.stderr) == (0, "")
    program = with_packages / "bin/criu"
    used = subprocess.run(
        [program, "--version"], env={"LD_DEBUG": "libs"}, capture_output=True, text=True, check=True
    ).stderr
    loaded = [line.split()[-1] for line in used.splitlines() if "calling init:" in line]
    assert len(loaded) > 10
    assert [path for path in loaded if not path.startswith(str(with_packages.resolve()))] == []
    able = probe(opened(program))
    assert (able.works, able.reason) == (True, "")

    before = program.readlink()
    assert " is there already: " in install_criu(with_packages, MIRROR=UNREACHABLE).stdout
    assert program.readlink() == before
    program.resolve().unlink()
    assert install_criu(with_packages, MIRROR=UNREACHABLE).returncode == 0
    assert opened(program).version
    assert len(list((with_packages / "trees").iterdir())) == 1


def test_a_user_without_rights_installs_it(cached, as_nobody, public):
    shutil.copytree(cached, public / "criu/packages")
    subprocess.run(["chown", "-R", "65534", public / "criu"], check=True)
    shutil.copy(SCRIPT, public)
    code = "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"
    done = as_nobody("-c", code, public / SCRIPT.name, public / "criu", home=public)
    assert (done.returncode, done.stderr) == (0, "")
    assert opened(public / "criu/bin/criu").version


def test_a_failed_download_leaves_nothing(tmp_path):
    """Neither an unreachable mirror is used, nor one without the distribution's signature."""
    fake = tmp_path / "mirror/dists/sid"
    (fake / "main/binary-amd64").mkdir(parents=True)
    (fake / "main/binary-amd64/Packages").write_text("Package: criu\nVersion: 9.9\n")
    (fake / "Release").write_text("Origin: Debian\nSuite: sid\nComponents: main\n")
    for mirror, why in ((UNREACHABLE, "127.0.0.1"), (f"file:{tmp_path}/mirror", "is not signed")):
        done = install_criu(tmp_path / "criu", MIRROR=mirror, SUITE="sid")
        assert done.returncode == 1
        assert why in done.stderr
        assert "build CRIU: docs/how-to/criu.md" in done.stderr
        assert sorted(path.name for path in (tmp_path / "criu").iterdir()) == ["lock", "trees"]
        assert list((tmp_path / "criu/trees").iterdir()) == []


def test_two_at_a_time_are_refused(tmp_path):
    with (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "another installation into " in install_criu(tmp_path).stderr


@pytest.mark.parametrize("name", ["a:b", "a;b", 'a"b', "a$b"])
def test_a_folder_that_the_dynamic_linker_cannot_read_is_refused(name, tmp_path):
    assert "the dynamic linker does not read" in install_criu(tmp_path / name).stderr
    assert not (tmp_path / name).exists()
