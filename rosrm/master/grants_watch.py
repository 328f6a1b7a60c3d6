"""Watch of the key files: new and revoked keys need no restart of the master."""

from __future__ import annotations

import logging
import math
from typing import Final

from rosrm.errors import ConfigError
from rosrm.keys import key_files
from rosrm.keys.security import Authority, NoSecurity

_log = logging.getLogger("rosrm.master")

#: Seconds between two looks at the files, and after a look at files that cannot be used.
_PERIOD: Final = 0.25
_AFTER_FAULT: Final = 2.0


class GrantsWatch:
    """Watch of the key files of this user.

    Args:
        security: of the master, to which changed grants are passed.
    """

    def __init__(self, security: Authority) -> None:
        self._security = security
        self._home = key_files.key_home()
        self._look_at = -math.inf
        self._version: object = None
        self._fault = ""

    def has_changed(self, now: float) -> bool:
        """Return True after the grants have changed; the security then has the new ones."""
        if isinstance(self._security, NoSecurity) or now < self._look_at:
            return False
        self._look_at = now + _PERIOD
        try:
            version = key_files.grants_version(self._home)
            if version == self._version:
                return False
            secret, grants = key_files.read_secret(self._home), key_files.read_grants(self._home)
        except (ConfigError, OSError) as fault:
            self._report(f"the keys stay as they were: {fault}", now)
            return False
        if secret is None:
            missing = self._home / key_files.CLUSTER_FILE
            self._report(f"{missing} is missing; its keys stay valid", now)
            return False
        self._version, self._fault = version, ""
        self._security.replace(secret, grants)
        return True

    def _report(self, fault: str, now: float) -> None:
        """Log a fault once; the files are read again until it has ended."""
        self._look_at = now + _AFTER_FAULT
        if fault != self._fault:
            self._fault = fault
            _log.error("%s", fault)
