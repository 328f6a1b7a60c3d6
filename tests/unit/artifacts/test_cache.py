"""The cache of artifacts on a host: assembly, bounds, use, damage."""

from __future__ import annotations

import errno
import os
import time

import pytest

from rosrm.artifacts import unpack
from rosrm.artifacts.cache import ArtifactCache
from rosrm.artifacts.pack import Archive
from rosrm.errors import Refused
from rosrm.model.artifacts import Artifact

MAX_SIZE = 1_000_000


@pytest.fixture
def root(tmp_path):
    return tmp_path / "cache"


@pytest.fixture
def cache(root):
    return ArtifactCache(root, MAX_SIZE)


@pytest.fixture
def offered(tmp_path):
    """Return a function that makes an artifact of a number of bytes, with its archive."""

    def make(name: str, size: int = 300_000) -> tuple[Artifact, bytes]:
        path = tmp_path / name.replace("/", "_")
        path.write_bytes(name.encode() * (size // len(name)))
        archive = Archive(path)
        content = archive.part(0, archive.size)
        return Artifact(name, archive.digest, archive.size), content

    return make


def fetch(cache, artifact: Artifact, content: bytes, used=()) -> None:
    incoming = cache.begin(artifact, used)
    incoming.write(content)
    cache.finish(incoming)


def trees(root) -> set[str]:
    return {path.name[:64] for path in (root / "trees").iterdir()}


def test_a_process_sees_its_artifacts_under_their_names(cache, offered):
    """The files are links to the cache: they need no room, and cannot be written."""
    (one, content), (two, other) = offered("a/model.onnx"), offered("b")
    assert cache.missing((one, two), []) == [one, two]
    fetch(cache, one, content)
    fetch(cache, two, other)
    assert cache.missing((one, two), []) == []
    directory = cache.assemble((one, two))
    model = directory / "a" / "model.onnx"
    assert model.read_bytes().startswith(b"a/model.onnx")
    assert (directory / "b").exists()
    assert model.stat().st_nlink == 2
    modes = [oct(path.stat().st_mode & 0o777) for path in (model, directory, directory / "a")]
    assert modes == ["0o444", "0o555", "0o555"]
    assert cache.assemble((one, two)) == directory


def test_an_artifact_that_arrives_twice_is_stored_once(cache, offered, root):
    """A cancelled fetch may complete all the same, while the next one of the artifact runs."""
    one, content = offered("model")
    cancelled = cache.begin(one, [])
    cancelled.write(content)
    incoming = cache.begin(one, [])
    cache.finish(cancelled)
    incoming.write(content)
    cache.finish(incoming)
    assert cache.missing((one,), []) == []
    assert not list((root / "incoming").iterdir())


def test_a_directory_is_an_artifact_like_a_file(cache, tmp_path):
    """Its files and links are below its name."""
    source = tmp_path / "scripts"
    (source / "lib").mkdir(parents=True)
    (source / "lib" / "x.py").write_text("x = 1\n")
    (source / "main").symlink_to("lib/x.py")
    archive = Archive(source)
    one = Artifact("scripts", archive.digest, archive.size)
    fetch(cache, one, archive.part(0, archive.size))
    assert (cache.assemble((one,)) / "scripts" / "main").read_text() == "x = 1\n"


def test_contents_with_another_digest_are_refused(cache, root, offered):
    """Nothing of them stays."""
    one, content = offered("a")
    with pytest.raises(Refused, match="does not match its digest"):
        fetch(cache, one, content[:-1] + b"x")
    assert not list((root / "incoming").iterdir())
    assert cache.missing((one,), []) == [one]


def test_the_artifact_used_longest_ago_gives_way(cache, root, offered):
    """Others stay, as far as there is room."""
    for number, name in enumerate("abc"):
        one, content = offered(name)
        fetch(cache, one, content)
        tree = next(path for path in (root / "trees").iterdir() if one.digest in path.name)
        os.utime(tree, (number, number))
    first, second = offered("a")[0], offered("b")[0]
    assert cache.missing((first,), []) == []  # used just now
    fetch(cache, *offered("d"))
    assert first.digest in trees(root)
    assert second.digest not in trees(root)


def test_what_a_process_uses_stays(cache, root, offered):
    """A host whose cache is full of used artifacts refuses the next one."""
    kept = [offered(name) for name in "abc"]
    for one, content in kept:
        fetch(cache, one, content)
    used = [tuple(one for one, _ in kept)]
    directory = cache.assemble(used[0])
    with pytest.raises(Refused, match=r"may have 1.0 MB in all, of which .* in use.*max_size"):
        cache.begin(offered("d")[0], used)
    assert len(trees(root)) == 3
    assert (directory / "a").exists()
    fetch(cache, *offered("d"))
    assert not directory.exists()


def test_an_artifact_larger_than_the_cache_is_refused(cache, root, offered):
    """The others stay."""
    fetch(cache, *offered("a"))
    with pytest.raises(Refused, match=r"artifact 'big' has 2.0 MB.*artifacts.max_size"):
        cache.begin(offered("big", 2_000_000)[0], [])
    assert len(trees(root)) == 1


def test_a_changed_artifact_is_fetched_again(cache, root, offered):
    """No later process gets what an earlier one has written into it."""
    one, content = offered("a")
    fetch(cache, one, content)
    file = cache.assemble((one,)) / "a"
    file.chmod(0o644)
    file.write_bytes(b"changed")
    assert cache.missing((one,), [(one,)]) == []  # a process uses it
    assert cache.missing((one,), []) == [one]
    fetch(cache, one, content)
    assert (cache.assemble((one,)) / "a").read_bytes() == b"a" * 300_000


def test_an_artifact_that_cannot_be_looked_at_now_is_kept(cache, offered, monkeypatch):
    """A lack of descriptors tells nothing about its files."""
    one, content = offered("a")
    fetch(cache, one, content)

    def lacks(_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with monkeypatch.context() as patched:
        patched.setattr(unpack, "_is_untouched", lacks)
        with pytest.raises(OSError, match="Too many open files"):
            cache.missing((one,), [])
    assert cache.missing((one,), []) == []


def test_a_restart_keeps_what_is_complete(cache, root, offered):
    """Archives that had not arrived are removed."""
    one, content = offered("a")
    fetch(cache, one, content)
    cache.begin(offered("b")[0], [])
    again = ArtifactCache(root, MAX_SIZE)
    assert again.missing((one,), []) == []
    assert not (root / "incoming").exists()


def test_a_cancelled_fetch_leaves_nothing(cache, root, offered):
    """Its room is free for others."""
    incoming = cache.begin(offered("a", 600_000)[0], [])
    cache.drop(incoming)
    cache.drop(incoming)
    assert not list((root / "incoming").iterdir())
    cache.drop(cache.begin(offered("b", 600_000)[0], []))


def test_the_last_use_is_remembered_over_a_restart(cache, root, offered):
    """The time of a tree's directory is that of its last use."""
    one, content = offered("a")
    fetch(cache, one, content)
    (tree,) = (root / "trees").iterdir()
    os.utime(tree, (1, 1))
    cache.missing((one,), [])
    assert time.time() - tree.stat().st_mtime < 60.0
