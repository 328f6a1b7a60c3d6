"""Files of all parts: other users can read none, even if the caller has no umask."""

from __future__ import annotations

import os
import stat

import pytest

from rosrm.model.values import Kind
from tests.ros.clusters import host, python


@pytest.fixture
def no_umask():
    former = os.umask(0)
    yield
    os.umask(former)


@pytest.mark.usefixtures("no_umask")
def test_no_file_of_state_is_readable_by_others(make_cluster) -> None:
    """Other users can open no journal, key, log, record or socket of master, slave, supervisor."""
    cluster = make_cluster(host("h0"))
    cluster.run(python("p", "print(1)", kind=Kind.JOB))
    cluster.submit(python("q", "import time; time.sleep(600)"))
    cluster.wait("q", "running")
    made = {
        str(path.relative_to(cluster.directory)): stat.S_IMODE(path.lstat().st_mode)
        for path in cluster.directory.rglob("*")
        if not path.is_symlink()
    }
    assert any(name.endswith(".key") for name in made)  # of the instance
    private = {name for name in made if "/" in name}
    assert {name: oct(made[name]) for name in private if made[name] & 0o077} == {}
