"""A certificate for one offer, that nobody has signed: its fingerprint travels in the offer."""

from __future__ import annotations

import datetime as dt
import hashlib
import os
import ssl

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


def new_certificate() -> tuple[ssl.SSLContext, str]:
    """What a server needs to show it, and its SHA-256. The key touches no disk."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rosrm")])
    # Robots' clocks differ, and the fetching side compares the fingerprint alone.
    now = dt.datetime.now(dt.timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=365))
        .not_valid_after(now + dt.timedelta(days=365))
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    _load(context, certificate.public_bytes(serialization.Encoding.PEM) + private)
    shown = certificate.public_bytes(serialization.Encoding.DER)
    return context, hashlib.sha256(shown).hexdigest()


def _load(context: ssl.SSLContext, chain: bytes) -> None:
    """As a file, which is all that `ssl` takes: one in memory."""
    memory = os.memfd_create("rosrm-transfer", os.MFD_CLOEXEC)
    with os.fdopen(memory, "wb") as file:
        file.write(chain)
        file.flush()
        context.load_cert_chain(f"/proc/self/fd/{memory}")
