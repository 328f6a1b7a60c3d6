"""Directories moved by real processes over real sockets: what arrives, and who may have it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import socket
import ssl
import stat
from pathlib import Path

import psutil
import pytest

from rosrm.errors import TransferError
from rosrm.transfer import Fetcher, Offer, Sender, Sent, fetch
from tests.integration.transfer.trees import PATIENCE, digests, fill, listens, nothing_left, through
from tests.integration.transfer.wires import Fault, wire

# --- as it should be -------------------------------------------------------------------------


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
    assert psutil.Process(sender._process.pid).net_connections("inet") == []
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


# --- who may ---------------------------------------------------------------------------------


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


def test_a_destination_that_was_introduced_is_the_only_one(source, target, sender, tmp_path):
    """Who has read the offer on its way, token and all, gets nothing, with or without a key."""
    with Fetcher() as fetcher, Fetcher() as other:
        offer = sender.offer(source, seconds=PATIENCE, to=fetcher.introduce())
        with pytest.raises(TransferError, match="is for another destination than this one"):
            fetch(offer, tmp_path / "second", timeout=PATIENCE)
        own = ssl.PEM_cert_to_DER_cert(other.introduce())
        for end, told in ((other, hashlib.sha256(own).hexdigest()), (Fetcher(), "")):
            forged = dataclasses.replace(offer, to=told)
            with end, pytest.raises(TransferError, match=r"the (TLS )?connection broke"):
                end.fetch(forged, tmp_path / "third", timeout=1.0)
        fetched = fetcher.fetch(offer, target, timeout=PATIENCE)
    assert digests(target) == digests(source)
    assert sender.wait(PATIENCE) == Sent("taken", fetched.received)


def test_a_token_is_needed_also_where_one_was_introduced(source, target, sender):
    with Fetcher() as fetcher:
        offer = sender.offer(source, seconds=PATIENCE, to=fetcher.introduce())
        with pytest.raises(TransferError, match="the token is not the one of this offer"):
            fetcher.fetch(dataclasses.replace(offer, token="guessed"), target, timeout=PATIENCE)


def test_an_introduction_that_is_none_is_refused(source, sender):
    with pytest.raises(TransferError, match="the destination's certificate is none"):
        sender.offer(source, seconds=PATIENCE, to="-----BEGIN NOTHING-----")


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
