"""Key of this host. A slave without a key waits for it: a master would drop its messages."""

from __future__ import annotations

import logging
import os
import time
from typing import Final

from rosrm import clocks
from rosrm.config.settings import HostConfig
from rosrm.keys import key_files
from rosrm.keys.cluster import PrincipalKey, own_grant
from rosrm.keys.derivation import KEY_BYTES
from rosrm.keys.finding import host_security
from rosrm.keys.roles import Principal
from rosrm.keys.security import Member, MemberSecurity

_log = logging.getLogger("rosrm.slave")

#: Seconds between two searches for the key, and between two messages to the user.
_LOOK: Final = 0.25
_LOG_PERIOD: Final = 60.0


def wait_for_security(config: HostConfig) -> Member:
    """Return the security of this slave, as soon as its host has a key.

    Raises:
        ConfigError: a key file is invalid, or others can read it.
    """
    logged_at = -_LOG_PERIOD
    while (found := host_security(config.security, config.host)) is None:
        now = clocks.boot_time()
        if now - logged_at >= _LOG_PERIOD:
            logged_at = now
            _log.info("%s", _how_to_get_a_key(config.host))
        time.sleep(_LOOK)
    return found


def _how_to_get_a_key(host: str) -> str:
    return (
        f"waiting for a key of host:{host} in {key_files.key_home()}: start `rosrm master` as this "
        f"user on this machine. If the master runs elsewhere, run `rosrm key add host:{host} --out "
        f"{host}.key` there, and copy the file to this directory"
    )


def security_without_key(host: str) -> Member:
    """Return a security with a random key, whose messages no master, slave or client accepts."""
    grant = own_grant(Principal("host", host))
    return MemberSecurity(PrincipalKey(grant, os.urandom(KEY_BYTES), os.urandom(KEY_BYTES)))
