"""Ends of a transfer that are stopped, killed or abandoned."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from rosrm.errors import TransferError
from rosrm_criu.transfer import Fetcher, Offer, OfferResult, Sender
from tests.integration.transfer.trees import (
    PATIENCE,
    digests,
    fetching,
    listens,
    nothing_left,
    slowly,
    wait_until_begun,
)
from tests.waiting import wait_until


def test_a_fetch_that_is_killed_leaves_no_half_target(source, target, sender, fetcher, destination):
    """A killed fetch leaves only a hidden directory, which the next fetch beside it removes."""
    offer = slowly(sender, source, fetcher.introduce())
    with fetching(fetcher, offer, target, timeout=PATIENCE) as going:
        fetcher._process.kill()
        with pytest.raises(TransferError, match="ended with status -9 and no answer"):
            going.result(PATIENCE)
    assert not target.exists()
    assert len(list(target.parent.iterdir())) == 1

    with Sender() as again:
        offer = again.offer(source, seconds=PATIENCE, to=destination.certificate)
        destination.fetch(offer, target)
    assert [path.name for path in target.parent.iterdir()] == ["target"]
    assert digests(target) == digests(source)


def test_a_fetch_can_be_stopped(source, target, sender, fetcher):
    """A fetch can be stopped from another thread, and leaves nothing."""
    offer = slowly(sender, source, fetcher.introduce())
    with fetching(fetcher, offer, target, timeout=PATIENCE) as going:
        fetcher.close()
        with pytest.raises(TransferError, match="stopped before everything was received"):
            going.result(PATIENCE)
    assert nothing_left(target)


def test_an_offer_can_be_withdrawn_in_mid_transfer(source, target, sender, fetcher):
    offer = slowly(sender, source, fetcher.introduce())
    with fetching(fetcher, offer, target, timeout=PATIENCE) as going:
        assert sender.close().outcome == "withdrawn"
        assert not listens(offer.port)
        with pytest.raises(TransferError, match=r"the transfer was cut"):
            going.result(PATIENCE)
    assert nothing_left(target)


def test_a_transfer_stopped_before_its_start_is_reported(source, target, sender):
    fetcher = Fetcher()
    offer = sender.offer(source, seconds=PATIENCE, to=fetcher.introduce())
    fetcher.close()
    with pytest.raises(TransferError, match="stopped before it began"):
        fetcher.fetch(offer, target, timeout=PATIENCE)


_OFFERS = """
import json, sys, time
from pathlib import Path
from rosrm_criu.transfer import Sender
sender = Sender()
offer = sender.offer(Path(sys.argv[1]), seconds=600.0, max_rate=500e3, to=sys.argv[2])
print(json.dumps(offer.as_json()))
print(sender._process.pid, flush=True)
time.sleep(600)
"""
_FETCHES = """
import json, sys
from pathlib import Path
from rosrm_criu.transfer import Fetcher, Offer
fetcher = Fetcher()
print(json.dumps([fetcher._process.pid, fetcher.introduce()]), flush=True)
offer = Offer.from_json(json.loads(sys.stdin.readline()))
fetcher.fetch(offer, Path(sys.argv[1]), timeout=600.0)
"""


def start(code: str, *arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_an_offer_ends_with_the_process_that_made_it(source, destination):
    """An offer ends when the process that made it is killed."""
    with start(_OFFERS, source, destination.certificate) as owner:
        offer = Offer.from_json(json.loads(owner.stdout.readline()))
        serving = Path(f"/proc/{owner.stdout.readline().strip()}")
        assert listens(offer.port)
        owner.kill()
        wait_until(lambda: not serving.exists() or is_dead(serving), "its end")
        assert not listens(offer.port)


def test_a_fetch_ends_with_the_process_that_asked_for_it(source, target, sender):
    """A fetch ends when the process that requested it is killed, and leaves nothing."""
    with start(_FETCHES, target) as owner:
        pid, certificate = json.loads(owner.stdout.readline())
        fetching = Path(f"/proc/{pid}")
        owner.stdin.write(json.dumps(slowly(sender, source, certificate).as_json()) + "\n")
        owner.stdin.flush()
        wait_until_begun(target)
        owner.kill()
        wait_until(lambda: not fetching.exists() or is_dead(fetching), "its end")
    assert nothing_left(target)


def is_dead(process: Path) -> bool:
    """Return True if a process has ended, even if it is not reaped."""
    try:
        return "State:\tZ" in (process / "status").read_text()
    except FileNotFoundError:
        return True


def test_a_killed_sender_is_reported(source, sender, destination):
    sender.offer(source, seconds=PATIENCE, to=destination.certificate)
    sender._process.kill()
    assert sender.wait(PATIENCE) == OfferResult("failed", 0)


def test_closing_twice_and_from_several_threads_does_no_harm(source, destination):
    sender = Sender()
    sender.offer(source, seconds=PATIENCE, to=destination.certificate)
    threads = [threading.Thread(target=sender.close) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert sender.close() == OfferResult("withdrawn", 0)


def test_a_destination_that_was_not_introduced_fetches_nothing(offer, target):
    """A fetch without `introduce` fails at once, because the source would refuse it."""
    with Fetcher() as fetcher, pytest.raises(TransferError, match="was not introduced"):
        fetcher.fetch(offer, target, timeout=PATIENCE)
    assert nothing_left(target)
