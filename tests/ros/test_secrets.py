"""Secrets in a real cluster."""

from __future__ import annotations

from pathlib import Path

from rosrm.config.settings import RecordSettings
from tests.ros.clusters import STEADY, host, python
from tests.waiting import all_commands, wait_until

SECRET = b"hush-4711"
#: Ends with success if it has the secret, and prints only that.
CHECK = f"""
import hashlib, os, time
assert os.environ["TOKEN"] == bytes.fromhex("{SECRET.hex()}").decode()
print("the secret has arrived", flush=True)
time.sleep(1000)
"""


def files_with(directory: Path, text: bytes) -> list[Path]:
    """Return the files below a directory that contain a text."""
    return [one for one in directory.rglob("*") if one.is_file() and text in one.read_bytes()]


def test_the_process_gets_its_secret_and_nobody_else(make_cluster, tmp_path) -> None:
    """Neither a file of master, slave and supervisor nor an answer to a client has the value."""
    token = tmp_path / "token"
    token.write_bytes(SECRET + b"\n")
    token.chmod(0o604)
    records = tmp_path / "records"
    cluster = make_cluster(host("a"), liveness=STEADY, record=RecordSettings(records))
    cluster.submit(python("robot", CHECK, secrets={"TOKEN": str(token)}))
    cluster.wait_for_log("robot", "the secret has arrived")
    cluster.wait("robot", "running")

    answers = [cluster.client.explain("robot"), cluster.client.list(events=True)]
    assert SECRET.decode() not in str(answers)
    assert SECRET.decode() not in all_commands()
    wait_until(lambda: files_with(records, b"robot"), "the recording has the process")
    assert files_with(cluster.directory, str(token).encode())
    assert not files_with(cluster.directory, SECRET)
    assert not files_with(records, SECRET)
    assert f"`chmod o-rw {token}`" in cluster.log_of("a")
