"""Self-signed certificates for one transfer; the master tells each side the other's certificate."""

from __future__ import annotations

import datetime as dt
import hashlib
import os
import secrets
import ssl
from dataclasses import dataclass, field
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

#: Always valid, because the clock of a robot without a real-time clock starts in 1970.
_FROM: Final = dt.datetime(1970, 1, 1, tzinfo=dt.timezone.utc)
_TO: Final = dt.datetime(9999, 12, 31, tzinfo=dt.timezone.utc)


@dataclass(frozen=True)
class TlsIdentity:
    """A certificate and its key, in memory only.

    Attributes:
        certificate: public, in PEM.
        fingerprint: SHA-256 of the certificate, in hexadecimal digits.
        key: secret, in PEM.
    """

    certificate: str
    fingerprint: str
    key: bytes = field(repr=False)

    def load_into(self, context: ssl.SSLContext) -> None:
        """Use the identity for connections, by a file in memory: `ssl` accepts only files."""
        memory = os.memfd_create("rosrm-transfer", os.MFD_CLOEXEC)
        with os.fdopen(memory, "wb") as file:
            file.write(self.certificate.encode() + self.key)
            file.flush()
            context.load_cert_chain(f"/proc/self/fd/{memory}")


def new_identity() -> TlsIdentity:
    """Create a new identity."""
    key = ec.generate_private_key(ec.SECP256R1())
    # The name is unique; otherwise a peer would take one certificate for the signer of another.
    own = f"rosrm {secrets.token_hex(8)}"
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, own)])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_FROM)
        .not_valid_after(_TO)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    shown = certificate.public_bytes(serialization.Encoding.PEM).decode()
    return TlsIdentity(certificate=shown, fingerprint=fingerprint_of(shown), key=private)


def fingerprint_of(certificate: str) -> str:
    """Return the SHA-256 of a PEM certificate in hexadecimal digits; raise `ValueError`."""
    x509.load_pem_x509_certificate(certificate.encode())
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate)).hexdigest()
