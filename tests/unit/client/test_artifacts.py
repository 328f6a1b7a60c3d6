"""Sending of artifacts by a client: each once, from where the master needs them."""

from __future__ import annotations

from hashlib import sha256

import pytest

from rosrm.client.artifacts import send_artifacts
from rosrm.errors import ConfigError, Refused
from rosrm.model.artifacts import Artifact
from rosrm.model.values import ProcessSpec


class Master:
    """A master that stores what it receives, and restarts once at an offset."""

    def __init__(self, restarts_at: int = -1) -> None:
        self.begun: dict[str, bytes] = {}
        self.stored: dict[str, bytes] = {}
        self.restarts_at = restarts_at

    def store_artifact(self, digest: str, size: int, offset: int, data: bytes = b"") -> int:
        if digest in self.stored:
            return size
        if not data:
            return len(self.begun.setdefault(digest, b""))
        if offset == self.restarts_at:
            self.restarts_at = -1
            self.begun.clear()
        if digest not in self.begun:
            return 0
        if offset == len(self.begun[digest]):
            self.begun[digest] += data
        if len(self.begun[digest]) == size:
            if sha256(self.begun[digest]).hexdigest() != digest:
                raise Refused("other contents", "changed")
            self.stored[digest] = self.begun.pop(digest)
        return size if digest in self.stored else len(self.begun[digest])


@pytest.fixture
def big(tmp_path):
    path = tmp_path / "big.bin"
    path.write_bytes(bytes(range(256)) * 4000)
    return path


def spec(name: str, path, **others) -> ProcessSpec:
    return ProcessSpec(name, artifacts=(Artifact("data", source=str(path)),), **others)


def no_note(_: str) -> None:
    pytest.fail("sending was quick")


def test_equal_contents_are_sent_once(big):
    """Processes with the same file share its digest."""
    master = Master()
    one, two = send_artifacts(master, [spec("a", big), spec("b", big)], no_note)
    assert one.artifacts == two.artifacts
    (artifact,) = one.artifacts
    (digest,) = master.stored
    assert (artifact.digest, artifact.size) == (digest, len(master.stored[digest]))


def test_a_restarted_master_gets_the_contents_from_the_beginning(big):
    """The parts that it had received before are lost."""
    master = Master(restarts_at=256 << 10)
    send_artifacts(master, [spec("a", big)], no_note)
    assert len(master.stored) == 1


def test_a_changed_file_is_refused_by_its_name(big, monkeypatch):
    """The refusal of the master names a digest alone, which the user does not know."""
    master, first = Master(), Master.store_artifact

    def change(self, digest, size, offset, data=b""):
        if not data:
            big.write_bytes(bytes(1_024_000))
        return first(self, digest, size, offset, data)

    monkeypatch.setattr(Master, "store_artifact", change)
    with pytest.raises(Refused, match=r"big.bin changed while it was sent: run the command again"):
        send_artifacts(master, [spec("a", big)], no_note)
    assert not master.stored


def test_nothing_is_sent_if_one_file_is_missing(big, tmp_path):
    """All files are read before the first one is sent."""
    master = Master()
    with pytest.raises(ConfigError, match="none: there is no such file"):
        send_artifacts(master, [spec("a", big), spec("b", tmp_path / "none")], no_note)
    assert not master.begun
