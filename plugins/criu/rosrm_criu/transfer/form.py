"""What travels between the hosts of a transfer, and what becomes of one. Pure."""

from __future__ import annotations

import hashlib
import ipaddress
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rosrm.errors import TransferError

if TYPE_CHECKING:
    from typing_extensions import Self

#: Grows when a peer of another version could not understand it.
VERSION: Final = 1
#: Of the archive; its bytes follow the archive in the stream.
DIGEST: Final = "blake2b-256"
DIGEST_SIZE: Final = 32

#: Carries the number that a reader has drawn: the first reader of an offer is its only one.
READER_HEADER: Final = "Rosrm-Reader"

_HEX: Final = re.compile(r"[0-9a-f]{64}")
_MOST: Final = 1 << 60


def new_digest() -> hashlib.blake2b:
    """BLAKE2: half the work of SHA-256 where the processor has no instructions for that one."""
    return hashlib.blake2b(digest_size=DIGEST_SIZE)


@dataclass(frozen=True)
class Offer:
    """A directory that waits to be fetched, as its source describes it.

    Attributes:
        addresses: of the source, IPv4, those of loopback last.
        port: that it listens on.
        fingerprint: SHA-256 of the certificate that the source shows, in hexadecimal digits.
        token: opens it, once. A secret: it is in no log and no representation.
        size: bytes of all files.
        files: how many there are.
        length: bytes of the archive, uncompressed: what has to have room.
        seconds: that it stands from when it was made.
        to: SHA-256 of the certificate of the only destination that may fetch it.
        digest: how the archive's checksum is computed.
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
        """Plain values."""
        return {**asdict(self), "addresses": list(self.addresses)}

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> Self:
        """Raises `TransferError` for anything but an offer of this version."""
        version = told.get("version")
        if version != VERSION:
            raise TransferError(
                f"the source speaks version {version!r} of the transfer, this host {VERSION}: "
                "install the same rosrm on both"
            )
        try:
            offer = cls(**{**told, "addresses": tuple(told["addresses"])})
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
class Sent:
    """What became of an offer.

    Attributes:
        outcome: "taken": fetched and found whole; "expired": nobody did in time; "withdrawn":
            ended by the source; "failed": its process died.
        bytes: that went out, as compressed, those of broken connections included.
    """

    outcome: str
    bytes: int

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


@dataclass(frozen=True)
class Fetched:
    """A directory that was fetched.

    Attributes:
        address: of the source that was spoken with last.
        size: bytes of all files.
        files: how many there are.
        received: bytes that came in, as compressed.
        resumed: times that a broken connection was made again.
        seconds: from the request to the directory being in its place.
        checksum: of the archive, in hexadecimal digits.
    """

    address: str
    size: int
    files: int
    received: int
    resumed: int
    seconds: float
    checksum: str

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)
