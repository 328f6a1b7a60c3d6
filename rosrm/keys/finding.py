"""Choice of the security of a master, slave or client, from the key files of this user."""

from __future__ import annotations

import os
import time
from typing import Final

from rosrm import clocks
from rosrm.errors import NoMaster
from rosrm.keys import key_files
from rosrm.keys.roles import Principal, SecurityMode
from rosrm.keys.security import Authority, MasterSecurity, Member, MemberSecurity, NoSecurity

#: Environment variable with the path of the key file to use.
KEY_VARIABLE: Final = "ROSRM_KEY"

#: Seconds between two searches for a key.
_LOOK: Final = 0.05


def master_security(mode: SecurityMode) -> Authority:
    """Return the security of a master; create the cluster's secret if this user has none.

    Raises:
        ConfigError: a key file is invalid, or others can read it.
    """
    if mode == "none":
        return NoSecurity()
    home = key_files.key_home()
    return MasterSecurity(key_files.make_secret(home), key_files.read_grants(home))


def host_security(mode: SecurityMode, host: str) -> Member | None:
    """Return the security of a slave; None if its host has no key yet.

    Raises:
        ConfigError: a key file is invalid, or others can read it.
    """
    return _member(mode, Principal("host", host))


def user_security(mode: SecurityMode, timeout: float = 0.0) -> Member:
    """Return the security of a command or client of this user.

    Args:
        timeout: seconds to wait for a key: the first master of this user may be about to write it.

    Raises:
        NoMaster: this user has no key after `timeout`.
        ConfigError: a key file is invalid, or others can read it.
    """
    deadline = clocks.boot_time() + timeout
    me = Principal("user", key_files.user_name())
    while (found := _member(mode, me)) is None and clocks.boot_time() < deadline:
        time.sleep(_LOOK)
    if found is None:
        home = key_files.key_home()
        raise NoMaster(
            f"{me} has no key: {home} has neither {key_files.CLUSTER_FILE}, which `rosrm master` "
            f"creates at its first start, nor the key file of a user. If the master runs as "
            f"another user or on another machine, run `rosrm key add {me} --out {me.name}.key` "
            f"there, and copy that file to {home}"
        )
    return found


def _member(mode: SecurityMode, principal: Principal) -> Member | None:
    if mode == "none":
        return NoSecurity(principal)
    explicit = os.environ.get(KEY_VARIABLE, "")
    name = principal.name if principal.kind == "host" else ""
    key = key_files.find_key(principal.kind, name, key_files.key_home(), explicit)
    return None if key is None else MemberSecurity(key)
