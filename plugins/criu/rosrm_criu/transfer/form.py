"""Data that the hosts of a transfer exchange, and its results. Pure."""

from __future__ import annotations

import hashlib
import ipaddress
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

from rosrm.errors import TransferError

if TYPE_CHECKING:
    from typing_extensions import Self

#: Raised for a change that a peer of another version could not understand.
VERSION: Final = 2
#: Algorithm of the archive's checksum, whose bytes follow the archive in the stream.
DIGEST: Final = "blake2b-256"
DIGEST_SIZE: Final = 32

#: The stream consists of parts: each has a head with the number of its bytes, big-endian, and then
#: compressed bytes. After a part of no bytes follows the reason why the source stops, up to the end
#: of the connection.
PART_HEAD: Final = 4
#: Byte with which the destination confirms that it has received and verified everything.
TAKEN: Final = b"\x01"

_HEX: Final = re.compile(r"[0-9a-f]{64}")
_MOST: Final = 1 << 60
#: Most files of a directory, each of which takes an inode at the destination.
_MOST_FILES: Final = 100_000


def new_digest() -> hashlib.blake2b:
    """Return a BLAKE2 hash: half the work of SHA-256 on CPUs without SHA instructions."""
    return hashlib.blake2b(digest_size=DIGEST_SIZE)


@dataclass(frozen=True)
class Offer:
    """A directory that is ready to be fetched, as its source describes it.

    Attributes:
        addresses: IPv4 addresses of the source, loopback last.
        port: TCP port of the source.
        fingerprint: SHA-256 of the source's certificate, in hexadecimal digits.
        token: authorises one fetch. A secret: it is in no log and no representation.
        size: bytes of all files.
        files: number of files.
        length: bytes of the archive, uncompressed; the destination needs this much space.
        seconds: validity, from the creation of the offer.
        to: SHA-256 of the certificate of the only destination that may fetch it.
        digest: algorithm of the archive's checksum.
        version: of this description and of the stream.
    """

    addresses: tuple[str, ...]
    port: int
    fingerprint: str
    token: str = field(repr=False)
    size: int
    files: int
    length: int
    seconds: float
    to: str
    digest: str = DIGEST
    version: int = VERSION

    def as_json(self) -> dict[str, Any]:
        """Return the offer as plain values."""
        return {**asdict(self), "addresses": list(self.addresses)}

    @classmethod
    def from_json(cls, plain: Mapping[str, Any]) -> Self:
        """Return the offer; raise `TransferError` for anything but a valid one of this version."""
        version = plain.get("version")
        if version != VERSION:
            raise TransferError(
                f"the source speaks version {version!r} of the transfer, this host {VERSION}: "
                "install the same rosrm on both"
            )
        try:
            offer = cls(**{**plain, "addresses": tuple(plain["addresses"])})
        except (KeyError, TypeError):
            raise TransferError("what came as an offer is none: its fields are others") from None
        if not offer._is_sound():
            raise TransferError("what came as an offer is none: its values cannot be right")
        return offer

    def _is_sound(self) -> bool:
        counts = (self.size, self.files, self.length)
        texts = (*self.addresses, self.token, self.fingerprint, self.to)
        return (
            all(isinstance(one, str) for one in texts)
            and all(type(one) is int and 0 <= one < _MOST for one in counts)
            and self.files <= _MOST_FILES
            and type(self.port) is int
            and 0 < self.port < 1 << 16
            and type(self.seconds) in (int, float)
            and self.digest == DIGEST
            and bool(self.addresses and self.token)
            and bool(_HEX.fullmatch(self.fingerprint) and _HEX.fullmatch(self.to))
            and all(map(_is_address, self.addresses))
        )


def _is_address(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class OfferResult:
    """Result of an offer.

    Attributes:
        outcome: "taken": fetched and verified; "broken": the connection broke before that;
            "expired": not fetched in time; "withdrawn": ended by the source; "failed": its process
            died.
        bytes: compressed bytes that were sent.
    """

    outcome: Literal["taken", "broken", "expired", "withdrawn", "failed"]
    bytes: int


@dataclass(frozen=True)
class Fetched:
    """A directory that was fetched.

    Attributes:
        address: of the source, as it was reached.
        size: bytes of all files.
        files: number of files.
        received: compressed bytes that were received.
        seconds: from the request until the directory was in its place.
        checksum: of the archive, in hexadecimal digits.
    """

    address: str
    size: int
    files: int
    received: int
    seconds: float
    checksum: str
