"""Files of users: never a traceback, only a `ConfigError` with its place."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.config.cluster import load_cluster
from rosrm.config.host import load_host
from rosrm.config.work import load_work
from rosrm.errors import ConfigError, Refused
from rosrm.extensions.registry import Registry
from rosrm.model.rows import LogPart
from rosrm.ros.slave.services import LogQuery
from rosrm.slave.logs import newest_instance, read_log
from rosrm.supervisor import log_index, paths
from tests.fuzz.hostile import damaged_bytes, fuzzed, texts, uint64s

REGISTRY = Registry.discover()
PAGE = Path(__file__).parents[2] / "docs/reference/configuration.md"


def example(mark: str) -> bytes:
    """Return an example of the reference page."""
    text = PAGE.read_text(encoding="utf-8").split(f"<!-- {mark} -->")[1]
    return text.split("```yaml\n")[1].split("```")[0].encode()


LOADERS = {
    "cluster": (load_cluster, example("defaults: cluster")),
    "host": (load_host, example("defaults: host")),
    "work": (load_work, example("work")),
}
#: Pieces of YAML at the limits of what a loader meets.
PIECES = [
    b"&a [*a]", b"<<: *a", b"!!python/object/apply:os.system [id]", b"{}", b"[", b"? [a]: b",
    b"null", b"~", b".nan", b".inf", b"-.inf", b"1e999", b"0x" + b"f" * 400, b"9" * 5000,
    b"1:1:1", b"- - - -",
    b"\xff\xfe", b"\xed\xa0\x80", b"\0", b"---\n---\n", b"%YAML 3.0\n", b"\xef\xbb\xbf", b"|\n x",
    b"2026-01-01", b"!!binary x", b"!!set {a}", b"99999999999999999999 GiB", b"1e400s", b"${HOME}",
    b"{a: 1, a: 2}", b"[[" * 500, b"${a.b.c}", b"foreach: {x: [1]}", b"-1", b"'", b'"\\ud800"',
]  # fmt: skip


@st.composite
def files(draw, sound: bytes) -> bytes:
    """Draw a file with hostile pieces in place of some values."""
    lines = sound.split(b"\n")
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        piece = draw(st.sampled_from(PIECES) | texts.map(str.encode))
        key, colon, _ = lines[at].partition(b": ")
        lines[at] = key + colon + piece if colon else piece
    data = b"\n".join(lines)
    return draw(st.just(data) | damaged_bytes(data) | st.sampled_from(PIECES))


@pytest.mark.parametrize("kind", LOADERS)
@fuzzed(70)
@given(data=st.data())
def test_a_file_is_read_or_refused_with_a_message(kind, data):
    load, sound = LOADERS[kind]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "f.yaml"
        path.write_bytes(data.draw(files(sound)))
        with contextlib.suppress(ConfigError):
            load(path, REGISTRY)


# --- logs --------------------------------------------------------------------------------------

names = st.sampled_from(["p", "p", "..", "../p", "/etc/passwd", "p\0", ""]) | texts.filter(
    lambda one: len(one) < 90
)


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    Path(paths.log_folder(str(tmp_path))).mkdir()
    with pytest.raises(Refused):
        read_log(tmp_path, LogQuery("x" * 300, 1, 0, 0, 0, 0.0), ended=False)


QUERIES = st.builds(
    LogQuery, process=names, number=st.integers(0, 2) | uint64s,
    offset=st.integers(0, 20) | uint64s, max_bytes=st.integers(0, 8) | uint64s,
    tail=st.integers(0, 3) | uint64s,
    since=st.sampled_from([0.0, 1.0, 1e18, -1.0, float("nan"), float("inf"), float("-inf")]),
)  # fmt: skip


@fuzzed(150)
@given(query=QUERIES, index=st.binary(max_size=72), ended=st.booleans())
def test_a_log_is_read_or_refused(query, index, ended):
    """Whatever is asked for, nothing but the logs below the state directory is read."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "secret.1.log").write_bytes(b"secret")
        state = Path(folder) / "state"
        Path(paths.log_folder(str(state))).mkdir(parents=True)
        log = Path(paths.log_file(str(state), "p", 1))
        log.write_bytes(b"one\ntwo\nthree")
        Path(log_index.path_of(str(log))).write_bytes(index)
        with contextlib.suppress(Refused):
            part = read_log(state, query, ended=ended)
            assert isinstance(part, LogPart)
            assert part.content in b"one\ntwo\nthree"
        with contextlib.suppress(Refused):
            newest_instance(state, query.process)
