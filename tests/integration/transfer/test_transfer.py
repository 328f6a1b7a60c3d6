"""Transfers by real processes over real sockets: results and access control."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import socket
import ssl
import stat
from pathlib import Path

import psutil
import pytest

from rosrm.errors import TransferError
from rosrm_criu.transfer import Offer, OfferResult, Sender
from tests.integration.transfer.trees import (
    PATIENCE,
    Destination,
    digests,
    fetching,
    fill,
    listens,
    nothing_left,
    slowly,
)

# --- successful transfers --------------------------------------------------------------------


def test_100_mb_arrive_as_they_were(tmp_path, target, sender, fetcher):
    """All files arrive unchanged, readable by their owner alone, and the port is closed then."""
    source = tmp_path / "source"
    fill(source, megabytes=100, random_share=0.5)
    for end in (sender, fetcher):
        end.ready()  # its libraries may be loaded in advance
    offer = sender.offer(source, seconds=PATIENCE, max_rate=0, to=fetcher.introduce())
    told = Offer.from_json(json.loads(json.dumps(offer.as_json())))

    fetched = fetcher.fetch(told, target, timeout=PATIENCE)

    assert digests(target) == digests(source)
    assert (fetched.size, fetched.files) == (100_000_001, 5)
    assert 50_000_000 < fetched.received < 55_000_000, "compressed"
    for path in (target, *target.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)
    sent = sender.wait(PATIENCE)
    assert sent == OfferResult("taken", fetched.received)
    assert not listens(offer.port)
    assert [path.name for path in target.parent.iterdir()] == ["target"]


def test_a_directory_without_files_arrives(tmp_path, target, sender, destination):
    (tmp_path / "source" / "empty").mkdir(parents=True)
    offer = sender.offer(tmp_path / "source", seconds=PATIENCE, to=destination.certificate)
    fetched = destination.fetch(offer, target)
    assert (fetched.size, digests(target)) == (0, {"empty": "directory"})


def test_nothing_listens_before_there_is_something_to_fetch(sender):
    """A process that was started in advance has no socket."""
    assert psutil.Process(sender._process.pid).net_connections("inet") == []
    assert sender.close() == OfferResult("failed", 0)


def test_a_rate_is_kept(source, target, sender, destination):
    """A limit of 2 MB/s is kept: 4 MB take nearly 2 s at least."""
    offer = sender.offer(source, seconds=PATIENCE, max_rate=2e6, to=destination.certificate)
    assert destination.fetch(offer, target).seconds > 1.5


# --- access control --------------------------------------------------------------------------


def test_a_wrong_token_is_refused_and_the_right_one_still_works(offer, source, target, destination):
    with pytest.raises(TransferError, match=r"refuses .*: the token is not the one of this offer"):
        destination.fetch(dataclasses.replace(offer, token="guessed"), target)
    assert nothing_left(target)
    destination.fetch(offer, target)
    assert digests(target) == digests(source)


def test_an_offer_is_taken_once(offer, sender, target, tmp_path, destination):
    destination.fetch(offer, target)
    assert sender.wait(PATIENCE).outcome == "taken"
    with pytest.raises(TransferError, match=r"cannot be reached: .*its offer.* may be over"):
        destination.fetch(offer, tmp_path / "second")


def test_a_second_reader_is_refused(source, target, sender, tmp_path, destination):
    """While one reader fetches, another one with the token learns only that it was used."""
    offer = slowly(sender, source, destination.certificate)
    with fetching(destination, offer, target) as going:
        with pytest.raises(TransferError, match="another reader fetches it already"):
            destination.fetch(offer, tmp_path / "second")
        going.result(PATIENCE)
    assert not (tmp_path / "second").exists()


def test_a_destination_that_was_introduced_is_the_only_one(
    offer, source, target, sender, destination
):
    """An intercepted offer, including its token, is useless with another key."""
    other = Destination()
    with pytest.raises(TransferError, match="is for another destination than this one"):
        other.fetch(offer, target)
    forged = dataclasses.replace(offer, to=other.fingerprint)
    with pytest.raises(
        TransferError, match=r"the transfer was cut: |the TLS connection broke|reset by peer"
    ):
        other.fetch(forged, target, timeout=1.0)
    assert nothing_left(target)
    fetched = destination.fetch(offer, target)
    assert digests(target) == digests(source)
    assert sender.wait(PATIENCE) == OfferResult("taken", fetched.received)


def test_a_client_without_certificate_is_refused(offer):
    """A client without a certificate gets no byte of an answer, even with a valid token."""
    answer = b""
    with (
        socket.create_connection(("127.0.0.1", offer.port), timeout=PATIENCE) as plain,
        contextlib.suppress(ssl.SSLError, ConnectionError),
        trusting().wrap_socket(plain) as encrypted,
    ):
        encrypted.sendall(f"{offer.token}\n".encode())
        answer = encrypted.recv(1)
    assert answer == b""


def trusting() -> ssl.SSLContext:
    """Return a TLS context that accepts any server and shows no certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


@pytest.mark.parametrize("to", ["", "-----BEGIN NOTHING-----"])
def test_an_introduction_that_is_none_is_refused(source, sender, to):
    with pytest.raises(TransferError, match="the destination's certificate is no certificate"):
        sender.offer(source, seconds=PATIENCE, to=to)


def test_a_server_with_another_certificate_receives_nothing(offer, source, target, destination):
    """A server with another certificate does not even get the token."""
    with Sender() as other:
        elsewhere = other.offer(source, seconds=PATIENCE, to=destination.certificate)
        mistaken = dataclasses.replace(offer, port=elsewhere.port)
        with pytest.raises(TransferError, match="another server answers"):
            destination.fetch(mistaken, target)
        assert other.close() == OfferResult("withdrawn", 0)


def test_what_travels_is_no_plain_text(source, target, sender, tmp_path, destination):
    """The server refuses TLS 1.2, so that token and files are encrypted by TLS 1.3."""
    (source / "secret").write_bytes(b"plain text" * 1000)
    offer = sender.offer(source, seconds=PATIENCE, to=destination.certificate)
    context = trusting()
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with (
        socket.create_connection(("127.0.0.1", offer.port), timeout=PATIENCE) as plain,
        pytest.raises((ssl.SSLError, ConnectionError)),
    ):
        context.wrap_socket(plain)
    destination.fetch(offer, target)
    assert digests(target) == digests(source)


def test_the_token_is_in_no_command_line_environment_or_output(
    offer, target, sender, capfd, destination
):
    place = Path(f"/proc/{sender._process.pid}")
    seen = (place / "cmdline").read_bytes() + (place / "environ").read_bytes()
    destination.fetch(offer, target)
    sender.close()
    out, err = capfd.readouterr()
    assert offer.token not in out + err
    assert offer.token.encode() not in seen
    assert err == ""


def test_a_silent_client_does_not_block_others(offer, target, sender, destination):
    strangers = [
        socket.create_connection(("127.0.0.1", offer.port), timeout=PATIENCE) for _ in range(20)
    ]
    destination.fetch(offer, target)
    for one in strangers:
        one.close()
    assert sender.wait(PATIENCE).outcome == "taken"
