"""Transfers of a directory between virtual hosts over a network that is cut."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import pytest

from rosrm_lab import DATA
from tests.waiting import wait_until

#: Seconds for whatever a busy machine needs; nothing waits so long when all goes well.
PATIENCE = 90.0
#: Seconds; a fetch waits longer for the next byte (15 s), and TCP repeats lost packets.
LONG = 5.0
SIZE = 12_000_000
_SOURCE = """
import hashlib, json, os, sys
from pathlib import Path
from dataclasses import asdict
from rosrm_criu.transfer import Sender
directory = Path(sys.argv[1])
directory.mkdir()
content = os.urandom(int(sys.argv[2]))
(directory / "pages").write_bytes(content)
with Sender() as sender:
    offer = sender.offer(directory, seconds=120.0, max_rate=3e6, to=sys.argv[3])
    print(json.dumps([offer.as_json(), hashlib.sha256(content).hexdigest()]), flush=True)
    print(json.dumps(asdict(sender.wait(120.0))), flush=True)
"""
_DESTINATION = """
import hashlib, json, sys
from pathlib import Path
from rosrm.errors import TransferError
from dataclasses import asdict
from rosrm_criu.transfer import Fetcher, Offer
target = Path(sys.argv[1])
fetcher = Fetcher()
print(json.dumps(fetcher.introduce()), flush=True)
try:
    offer = Offer.from_json(json.loads(sys.stdin.readline()))
    fetched = asdict(fetcher.fetch(offer, target, timeout=float(sys.argv[2]), reserve=0))
    digest = hashlib.sha256((target / "pages").read_bytes()).hexdigest()
except TransferError as error:
    fetched, digest = {"error": str(error)}, ""
print(json.dumps([fetched, digest]))
"""


class Move:
    """Transfer from host1 to host2.

    Attributes:
        offer: the offer in its JSON form.
    """

    def __init__(self, lab, *, timeout: float) -> None:
        self.lab = lab
        self.target = f"{DATA}/tmp/target"
        self.destination = self._run("host2", _DESTINATION, self.target, str(timeout))
        certificate = json.loads(self.destination.stdout.readline())
        self.source = self._run("host1", _SOURCE, f"{DATA}/tmp/source", str(SIZE), certificate)
        self.offer, self.digest = json.loads(self.source.stdout.readline())
        self.destination.stdin.write(json.dumps(self.offer).encode() + b"\n")
        self.destination.stdin.flush()

    def _run(self, host: str, code: str, *arguments: str) -> subprocess.Popen:
        command = [sys.executable, "-c", code, *arguments]
        pipe = subprocess.PIPE
        return self.lab.popen(host, command, limited=False, stdin=pipe, stdout=pipe)

    def wait_until_it_flows(self) -> None:
        place = self.lab.outside("host2", f"{DATA}/tmp")
        pages = ".rosrm-fetch-*/pages"
        wait_until(lambda: any(one.stat().st_size for one in place.glob(pages)), "the first bytes")

    def fetched(self) -> tuple[dict, str]:
        said, _ = self.destination.communicate(timeout=PATIENCE)
        return tuple(json.loads(said))

    def close(self) -> None:
        for one in (self.source, self.destination):
            one.kill()
            one.communicate()


@pytest.fixture
def move(lab):
    made = []

    def begin(**settings) -> Move:
        made.append(Move(lab, **settings))
        return made[-1]

    yield begin
    for one in made:
        one.close()


def test_a_transfer_continues_when_the_network_is_back(lab, move):
    """TCP bridges a cut that is shorter than the time that a fetch waits for the next byte."""
    moving = move(timeout=PATIENCE)
    moving.wait_until_it_flows()
    lab.cut("host1")
    time.sleep(LONG)
    lab.heal("host1")
    fetched, digest = moving.fetched()
    assert digest == moving.digest, fetched
    assert fetched["address"] == lab.address("host1")
    assert fetched["received"] < SIZE * 1.1
    assert json.loads(moving.source.stdout.readline())["outcome"] == "taken"


def test_a_transfer_over_a_network_that_stays_cut_fails_in_time(lab, move):
    """The error has the number of received bytes, and the destination keeps no file."""
    moving = move(timeout=7.0)
    moving.wait_until_it_flows()
    lab.cut("host1")
    fetched, _ = moving.fetched()
    assert f"of {moving.offer['length']} bytes" in fetched["error"]
    assert not list(lab.outside("host2", f"{DATA}/tmp").iterdir())
