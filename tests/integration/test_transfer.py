"""Directories moved by real processes over real sockets, and all that can come between."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import random
import signal
import socket
import ssl
import stat
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rosrm.errors import TransferError
from rosrm.transfer import Fetcher, Offer, Sender, Sent, fetch
from tests.faults.disks import small_disk
from tests.integration.wires import Fault, wire

#: Generous: a busy machine may take its time.
PATIENCE = 60.0


@pytest.fixture
def source(tmp_path):
    """Some files of 4 MB in all, which no compression makes smaller."""
    directory = tmp_path / "source"
    fill(directory, megabytes=4)
    return directory


@pytest.fixture
def target(tmp_path):
    return tmp_path / "there" / "target"


@pytest.fixture
def sender():
    with Sender() as sender:
        yield sender


def fill(directory: Path, *, megabytes: int, random_share: float = 1.0) -> None:
    (directory / "pages" / "empty").mkdir(parents=True)
    bits = random.Random(7)
    for number in range(4):
        with (directory / "pages" / f"{number}.img").open("wb") as file:
            for _ in range(megabytes * 1_000_000 // 4 // 50_000):
                fresh = int(50_000 * random_share)
                file.write(bits.randbytes(fresh) + bytes(50_000 - fresh))
    (directory / "inventory").write_bytes(b"1")


def digests(directory: Path) -> dict[str, str]:
    return {
        str(path.relative_to(directory)): hashlib.sha256(path.read_bytes()).hexdigest()
        if path.is_file() else "directory"
        for path in directory.rglob("*")
    }  # fmt: skip


def through(offer: Offer, port: int) -> Offer:
    return dataclasses.replace(offer, addresses=("127.0.0.1",), port=port)


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
    except ConnectionRefusedError:
        return False
    return True


def until(what: str, condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"not within {PATIENCE} s: {what}"
        time.sleep(0.02)


def nothing_left(target: Path) -> bool:
    return not target.parent.exists() or list(target.parent.iterdir()) == []


# --- as it should be --------------------------------------------------------------------------


def test_100_mb_arrive_as_they_were(tmp_path, target, sender):
    """Every file, for its owner alone; then nothing listens any more."""
    source = tmp_path / "source"
    fill(source, megabytes=100, random_share=0.5)
    offer = sender.offer(source, seconds=PATIENCE, max_rate=0)
    told = Offer.from_json(json.loads(json.dumps(offer.as_json())))

    fetched = fetch(told, target, timeout=PATIENCE)

    assert digests(target) == digests(source)
    assert (fetched.size, fetched.files, fetched.resumed) == (100_000_001, 5, 0)
    assert 50_000_000 < fetched.received < 55_000_000, "compressed"
    for path in (target, *target.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)
    sent = sender.wait(PATIENCE)
    assert sent == Sent("taken", fetched.received)
    assert not listens(offer.port)
    assert [path.name for path in target.parent.iterdir()] == ["target"]


def test_a_directory_without_files_arrives(tmp_path, target, sender):
    (tmp_path / "source" / "empty").mkdir(parents=True)
    offer = sender.offer(tmp_path / "source", seconds=PATIENCE)
    fetched = fetch(offer, target, timeout=PATIENCE)
    assert (fetched.size, digests(target)) == (0, {"empty": "directory"})


def test_nothing_listens_before_there_is_something_to_fetch(sender):
    """A process that was started ahead has no socket."""
    open_now = [str(one.readlink()) for one in Path(f"/proc/{sender._process.pid}/fd").iterdir()]
    assert not any(one.startswith("socket:") for one in open_now)
    assert sender.close() == Sent("failed", 0)


def test_an_offer_to_this_host_alone_listens_on_loopback(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE, loopback=True)
    assert offer.addresses == ("127.0.0.1",)
    listening = [
        line.split()[1]
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
        if line.split()[1].endswith(f":{offer.port:04X}") and line.split()[3] == "0A"
    ]
    assert listening == [f"0100007F:{offer.port:04X}"]
    assert fetch(offer, target, timeout=PATIENCE).address == "127.0.0.1"


@pytest.mark.parametrize("slow", ["source", "destination"])
def test_a_rate_is_kept(source, target, sender, slow):
    """4 MB take at least 2 s at 2 MB/s, whoever asks for it."""
    rates = {"source": 0.0, "destination": 0.0, slow: 2e6}
    offer = sender.offer(source, seconds=PATIENCE, max_rate=rates["source"])
    fetched = fetch(offer, target, timeout=PATIENCE, max_rate=rates["destination"])
    assert fetched.seconds > 1.5


# --- who may ----------------------------------------------------------------------------------


def test_a_wrong_token_is_refused_and_the_right_one_still_works(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with pytest.raises(TransferError, match=r"refuses .*: the token is not the one of this offer"):
        fetch(dataclasses.replace(offer, token="guessed"), target, timeout=PATIENCE)
    assert nothing_left(target)
    fetch(offer, target, timeout=PATIENCE)
    assert digests(target) == digests(source)


def test_an_offer_is_taken_once(source, target, sender, tmp_path):
    offer = sender.offer(source, seconds=PATIENCE)
    fetch(offer, target, timeout=PATIENCE)
    with pytest.raises(TransferError, match=r"cannot be reached: .*its offer.* may be over"):
        fetch(offer, tmp_path / "second", timeout=PATIENCE)


def test_nobody_goes_on_where_another_reader_began(source, target, sender, tmp_path):
    """Who has the token as well can tell that it was used, and gets nothing."""
    offer = sender.offer(source, seconds=PATIENCE)
    with (
        wire(offer.port, Fault(after=1_000_000), then_gone=True) as cut,
        pytest.raises(TransferError, match="was cut after"),
    ):
        fetch(through(offer, cut.port), target, timeout=PATIENCE)
    with pytest.raises(TransferError, match="somebody has begun to fetch it already"):
        fetch(offer, tmp_path / "second", timeout=PATIENCE)
    assert not (tmp_path / "second").exists()


def test_another_server_is_told_nothing(source, target, sender):
    """It shows another certificate, and so does not even see the token."""
    offer = sender.offer(source, seconds=PATIENCE)
    with Sender() as other:
        elsewhere = other.offer(source, seconds=PATIENCE)
        mistaken = dataclasses.replace(offer, port=elsewhere.port)
        with pytest.raises(TransferError, match="another server answers"):
            fetch(mistaken, target, timeout=PATIENCE)
        assert other.close() == Sent("withdrawn", 0)


def test_what_travels_is_no_plain_text(source, target, sender, tmp_path):
    """Neither the token nor a file can be read on the way; nor does old TLS do."""
    (source / "secret").write_bytes(b"plain text" * 1000)
    offer = sender.offer(source, seconds=PATIENCE)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with (
        socket.create_connection(("127.0.0.1", offer.port), timeout=PATIENCE) as plain,
        pytest.raises((ssl.SSLError, ConnectionError)),
    ):
        context.wrap_socket(plain)
    fetch(offer, target, timeout=PATIENCE)
    assert digests(target) == digests(source)


def test_the_token_is_in_no_command_line_environment_or_output(source, target, sender, capfd):
    offer = sender.offer(source, seconds=PATIENCE)
    place = Path(f"/proc/{sender._process.pid}")
    seen = (place / "cmdline").read_bytes() + (place / "environ").read_bytes()
    fetch(offer, target, timeout=PATIENCE)
    sender.close()
    out, err = capfd.readouterr()
    assert offer.token not in out + err
    assert offer.token.encode() not in seen
    assert err == ""


def test_a_stranger_that_says_nothing_hinders_nobody(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    strangers = [
        socket.create_connection(("127.0.0.1", offer.port), timeout=PATIENCE) for _ in range(20)
    ]
    fetch(offer, target, timeout=PATIENCE)
    for one in strangers:
        one.close()
    assert sender.wait(PATIENCE).outcome == "taken"


# --- what comes between -----------------------------------------------------------------------


def test_a_connection_that_was_cut_is_gone_on_with(source, target, sender):
    """What has come is not sent again, but for what was on the way."""
    offer = sender.offer(source, seconds=PATIENCE)
    with wire(offer.port, Fault(after=1_000_000), Fault(after=2_000_000)) as cut:
        fetched = fetch(through(offer, cut.port), target, timeout=PATIENCE)
    assert digests(target) == digests(source)
    assert fetched.resumed == 2
    assert fetched.received < 5_500_000
    assert sender.wait(PATIENCE).outcome == "taken"


def test_a_source_that_is_gone_in_mid_transfer_leaves_nothing(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    why = rf"cut after \d{{5,}} of {offer.length} bytes \(the (TLS )?connection broke\).*refused"
    with (
        wire(offer.port, Fault(after=1_000_000), then_gone=True) as cut,
        pytest.raises(TransferError, match=why),
    ):
        fetch(through(offer, cut.port), target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_byte_that_was_damaged_on_the_way_is_sent_again(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with wire(offer.port, Fault(after=1_000_000, flips=True)) as damaging:
        fetched = fetch(through(offer, damaging.port), target, timeout=PATIENCE)
    assert digests(target) == digests(source)
    assert fetched.resumed == 1


def test_a_wire_that_damages_every_time_is_given_up(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with (
        wire(offer.port, for_each=lambda _: Fault(after=20_000, flips=True)) as damaging,
        pytest.raises(TransferError, match=r"was cut after .* it broke again and again"),
    ):
        fetch(through(offer, damaging.port), target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_silent_source_is_given_up_in_time(source, target, sender):
    """Stopped in the middle: it neither sends nor closes."""
    offer = sender.offer(source, seconds=PATIENCE, max_rate=500e3)
    with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
        going = threads.submit(fetcher.fetch, offer, target, timeout=3.0)
        try:
            until("something has come", lambda: list(target.parent.glob(".rosrm-fetch-*/*")))
            os.kill(sender._process.pid, signal.SIGSTOP)
            with pytest.raises(TransferError, match=r"was cut after|took longer than 3 s"):
                going.result(PATIENCE)
        finally:
            os.kill(sender._process.pid, signal.SIGCONT)
    assert nothing_left(target)


def test_a_transfer_that_takes_too_long_is_given_up(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE, max_rate=500e3)
    with pytest.raises(TransferError, match=r"took longer than 1 s: \d+ of \d+ bytes had come"):
        fetch(offer, target, timeout=1.0)
    assert nothing_left(target)


def test_nobody_at_any_address(source, target, sender):
    """All of them are named."""
    offer = sender.offer(source, seconds=PATIENCE)
    sender.close()
    with pytest.raises(TransferError) as caught:
        fetch(offer, target, timeout=PATIENCE)
    for address in offer.addresses:
        assert f"{address}:{offer.port}: connection refused" in str(caught.value)
    assert nothing_left(target)


def test_an_offer_ends_by_itself(source, target, sender):
    offer = sender.offer(source, seconds=0.2)
    assert sender.wait(PATIENCE) == Sent("expired", 0)
    assert not listens(offer.port)
    with pytest.raises(TransferError, match=r"its offer, which stands for 0\.2 s, may be over"):
        fetch(offer, target, timeout=PATIENCE)


def test_an_offer_that_ends_in_mid_transfer(source, target, sender):
    offer = sender.offer(source, seconds=1.0, max_rate=500e3)
    with pytest.raises(TransferError, match=r"was cut after|cannot be reached"):
        fetch(offer, target, timeout=PATIENCE)
    assert sender.close().outcome == "expired"
    assert nothing_left(target)


def test_files_that_changed_since_they_were_offered_are_refused(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    (source / "pages" / "1.img").write_bytes(b"other")
    with pytest.raises(TransferError, match=r"refuses .*1\.img has changed since it was offered"):
        fetch(offer, target, timeout=PATIENCE)
    assert nothing_left(target)


def test_a_directory_that_is_gone_since_it_was_offered(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    source.rename(source.with_name("elsewhere"))
    with pytest.raises(TransferError, match=r"refuses .* is gone"):
        fetch(offer, target, timeout=PATIENCE)


def test_a_directory_that_is_not_there_is_not_offered(tmp_path, sender):
    with pytest.raises(TransferError, match="is gone, or was never there"):
        sender.offer(tmp_path / "none", seconds=PATIENCE)


# --- disks ------------------------------------------------------------------------------------


def test_what_has_no_room_is_not_begun(source, sender, tmp_path):
    """The source's offer still stands for a place with more room."""
    offer = sender.offer(source, seconds=PATIENCE)
    with small_disk(tmp_path / "disk") as disk:
        with pytest.raises(TransferError, match=r"do not fit .* the file system .*/disk has"):
            fetch(offer, disk.place / "target", timeout=PATIENCE, reserve=0)
        assert list(disk.place.iterdir()) == []
    fetch(offer, tmp_path / "target", timeout=PATIENCE)


def test_a_reserve_stays_free(source, target, sender):
    offer = sender.offer(source, seconds=PATIENCE)
    with pytest.raises(TransferError, match=r"are to stay free, and the file system"):
        fetch(offer, target, timeout=PATIENCE, reserve=1 << 60)
    assert nothing_left(target)


def test_a_disk_that_is_full_meanwhile(sender, tmp_path):
    """Others write too: what came is removed, and the error names the file system."""
    source = tmp_path / "source"
    source.mkdir()
    (source / "pages").write_bytes(random.Random(7).randbytes(600_000))
    with small_disk(tmp_path / "disk") as disk:
        offer = sender.offer(source, seconds=PATIENCE, max_rate=200e3)
        with Fetcher() as fetcher, ThreadPoolExecutor() as threads:
            going = threads.submit(
                fetcher.fetch, offer, disk.place / "target", timeout=PATIENCE, reserve=0
            )
            until("something has come", lambda: list(disk.place.glob(".rosrm-fetch-*/*")))
            disk.fill()
            with pytest.raises(TransferError, match=r"No space left on device; the file system"):
                going.result(PATIENCE)
        assert [path.name for path in disk.place.iterdir()] == ["filler"]


# --- processes that end -----------------------------------------------------------------------


def slowly(sender: Sender, source: Path) -> Offer:
    return sender.offer(source, seconds=PATIENCE, max_rate=500e3)


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
