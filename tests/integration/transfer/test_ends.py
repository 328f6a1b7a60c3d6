"""Ends of a transfer that are stopped, killed, or left alone."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rosrm.errors import TransferError
from rosrm.transfer import Fetcher, Offer, Sender, Sent, fetch
from tests.integration.transfer.trees import PATIENCE, digests, listens, nothing_left, slowly, until


def test_a_fetch_that_is_killed_leaves_no_half_target(source, target, sender):
    """What it leaves is hidden, and removed by the next fetch beside it."""
    offer = slowly(sender, source)
    with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
        going = threads.submit(fetcher.fetch, offer, target, timeout=PATIENCE)
        until("something has come", lambda: list(target.parent.glob(".rosrm-fetch-*/*")))
        fetcher._process.kill()
        with pytest.raises(TransferError, match="ended with status -9 and no answer"):
            going.result(PATIENCE)
    assert not target.exists()
    assert len(list(target.parent.iterdir())) == 1

    with Sender() as again:
        fetch(again.offer(source, seconds=PATIENCE), target, timeout=PATIENCE)
    assert [path.name for path in target.parent.iterdir()] == ["target"]
    assert digests(target) == digests(source)


def test_a_fetch_can_be_stopped(source, target, sender):
    """From another thread; nothing is left."""
    with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
        going = threads.submit(fetcher.fetch, slowly(sender, source), target, timeout=PATIENCE)
        until("something has come", lambda: list(target.parent.glob(".rosrm-fetch-*/*")))
        fetcher.close()
        with pytest.raises(TransferError, match="stopped before all had come"):
            going.result(PATIENCE)
    assert nothing_left(target)


def test_an_offer_can_be_withdrawn_in_mid_transfer(source, target, sender):
    offer = slowly(sender, source)
    with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
        going = threads.submit(fetcher.fetch, offer, target, timeout=PATIENCE)
        until("something has come", lambda: list(target.parent.glob(".rosrm-fetch-*/*")))
        assert sender.close().outcome == "withdrawn"
        assert not listens(offer.port)
        with pytest.raises(TransferError, match=r"was cut after .*connection refused"):
            going.result(PATIENCE)
    assert nothing_left(target)


def test_what_was_stopped_before_it_began_says_so(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    fetcher = Fetcher()
    fetcher.close()
    with pytest.raises(TransferError, match="ended with status 0 and no answer"):
        fetcher.fetch(offer, target, timeout=PATIENCE)


_OFFERS = """
import json, sys, time
from pathlib import Path
from rosrm.transfer import Sender
sender = Sender()
print(json.dumps(sender.offer(Path(sys.argv[1]), seconds=600.0, max_rate=500e3).as_json()))
print(sender._process.pid, flush=True)
time.sleep(600)
"""
_FETCHES = """
import json, sys
from pathlib import Path
from rosrm.transfer import Fetcher, Offer
fetcher = Fetcher()
print(fetcher._process.pid, flush=True)
fetcher.fetch(Offer.from_json(json.loads(sys.argv[1])), Path(sys.argv[2]), timeout=600.0)
"""


def start(code: str, *arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_an_offer_ends_with_the_process_that_made_it(source):
    """However that ends."""
    with start(_OFFERS, source) as owner:
        offer = Offer.from_json(json.loads(owner.stdout.readline()))
        serving = Path(f"/proc/{owner.stdout.readline().strip()}")
        assert listens(offer.port)
        owner.kill()
        until("its process has ended", lambda: not serving.exists() or is_dead(serving))
        assert not listens(offer.port)


def test_a_fetch_ends_with_the_process_that_asked_for_it(source, target, sender):
    """However that ends; nothing is left."""
    with start(_FETCHES, json.dumps(slowly(sender, source).as_json()), target) as owner:
        fetching = Path(f"/proc/{owner.stdout.readline().strip()}")
        until("something has come", lambda: list(target.parent.glob(".rosrm-fetch-*/*")))
        owner.kill()
        until("its process has ended", lambda: not fetching.exists() or is_dead(fetching))
    assert nothing_left(target)


def is_dead(process: Path) -> bool:
    """Ended, though nobody has taken note of it."""
    try:
        return "State:\tZ" in (process / "status").read_text()
    except FileNotFoundError:
        return True


def test_a_sender_that_is_killed_says_so(source, sender):
    sender.offer(source, seconds=PATIENCE)
    sender._process.kill()
    assert sender.wait(PATIENCE) == Sent("failed", 0)


def test_closing_twice_and_from_several_threads_does_no_harm(source):
    sender = Sender()
    sender.offer(source, seconds=PATIENCE)
    threads = [threading.Thread(target=sender.close) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert sender.close() == Sent("withdrawn", 0)


def test_an_end_that_is_ready_works_as_any_other(source, target):
    """Its libraries are there before somebody has to stand still for them."""
    with Sender() as sender, Fetcher() as fetcher:
        for end in (sender, fetcher):
            end.ready()
        offer = sender.offer(source, seconds=PATIENCE, to=fetcher.introduce())
        fetcher.fetch(offer, target, timeout=PATIENCE)
    assert digests(target) == digests(source)
