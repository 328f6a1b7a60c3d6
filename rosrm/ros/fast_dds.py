"""Fast DDS settings of rosrm's components and of migratable nodes (decisions 0009, 0015)."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import IO, Final, Literal

#: The first is the one that Fast DDS 2.14 (Jazzy) reads. A value set by the user is not changed.
_VARIABLES: Final = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_PROFILES: Final = Path(__file__).parent / "profiles"

#: File system in memory, which Fast DDS needs for its shared memory anyway.
_IN_MEMORY: Final = "/dev/shm"  # noqa: S108 - the files have random names and are private

_TRANSPORTS: Final = "FASTDDS_BUILTIN_TRANSPORTS"
_UDP: Final = "UDPv4"

#: Part of a profile with a UDP transport on one interface, and the part that selects it.
_TRANSPORT: Final = """\
  <transport_descriptors><transport_descriptor>
    <transport_id>rosrm_interface</transport_id>
    <type>UDPv4</type>
    <interfaceWhiteList><address>{interface}</address></interfaceWhiteList>
  </transport_descriptor></transport_descriptors>
"""
#: Not `xml.sax.saxutils.escape`, whose module imports the whole HTTP client (2.6 MB).
_ESCAPED: Final = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;"})
_ONLY_TRANSPORT: Final = """\
      <userTransports><transport_id>rosrm_interface</transport_id></userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
"""

#: Seconds without a message after which peers remove a master, slave or client; by default 20. A
#: process that was stopped for longer than this removes all of its peers when it continues, and
#: Fast DDS 2.14 may ignore some of them from then on (docs/decisions/0065).
LEASE: Final = 120
_LEASE: Final = f"<leaseDuration><sec>{LEASE}</sec></leaseDuration>"
_BEFORE: Final = "<leaseAnnouncement>"

Pace = Literal["eager", "steady"]


def announcements(environment: Mapping[str, str], pace: Pace, *, udp: bool) -> dict[str, str]:
    """Return the variables that configure a participant; none if the user has set a profile.

    Args:
        environment: may have a profile, or transports, of the user.
        udp: receive by UDP alone, unless the user has set other transports. A killed process leaves
            ports in shared memory that delay its peers. Nodes may accept that for large messages;
            rosrm's components must not.
    """
    if any(variable in environment for variable in _VARIABLES):
        return {}
    if not udp or environment.get(_TRANSPORTS, _UDP) != _UDP:
        return {_VARIABLES[0]: str(_PROFILES / f"{pace}.xml")}
    variables = {_VARIABLES[0]: str(_PROFILES / f"{pace}-udp.xml"), _TRANSPORTS: _UDP}
    return {name: value for name, value in variables.items() if name not in environment}


@contextlib.contextmanager
def announcing(environment: MutableMapping[str, str], pace: Pace, *, udp: bool) -> Iterator[None]:
    """Apply `announcements` to this process while a participant is created.

    The environment is restored afterwards, for the processes that this one starts.
    """
    with _changed(environment, announcements(environment, pace, udp=udp)):
        yield


@contextlib.contextmanager
def announcing_part(environment: MutableMapping[str, str], pace: Pace) -> Iterator[None]:
    """Apply `announcements` with `LEASE` to the participant of a master, slave or client."""
    variables = announcements(environment, pace, udp=True)
    if not variables:
        yield
        return
    profile = Path(variables[_VARIABLES[0]]).read_text(encoding="utf-8")
    with _applied(environment, variables, profile):
        yield


@contextlib.contextmanager
def bound(environment: MutableMapping[str, str], pace: Pace, interface: str) -> Iterator[None]:
    """Bind a participant to one network interface, as `announcing_part`.

    Fast DDS reads its profile once, for the first participant of a process. The profile replaces a
    profile of the user.

    Args:
        environment: of this process.
        pace: frequency of the announcements.
        interface: name or IPv4 address of the interface.
    """
    with _applied(environment, {_TRANSPORTS: _UDP}, _bound_profile(pace, interface)):
        yield


@contextlib.contextmanager
def _applied(
    environment: MutableMapping[str, str], variables: Mapping[str, str], profile: str
) -> Iterator[None]:
    """Apply variables, and a profile with `LEASE` in a temporary file."""
    with _temporary_file() as file:
        file.write(profile.replace(_BEFORE, f"{_LEASE}{_BEFORE}", 1))
        file.flush()
        with _changed(environment, {**variables, _VARIABLES[0]: file.name}):
            yield


def _temporary_file() -> IO[str]:
    """Create a temporary file, in memory if possible: the disk may be full, or read-only.

    Fast DDS reads only a file with a path, so none of `memory_file`.
    """
    with contextlib.suppress(OSError):
        return tempfile.NamedTemporaryFile("w", prefix="rosrm-", suffix=".xml", dir=_IN_MEMORY)
    return tempfile.NamedTemporaryFile("w", prefix="rosrm-", suffix=".xml")


def _bound_profile(pace: Pace, interface: str) -> str:
    """Return the profile of a pace, with one UDP transport on one interface."""
    profile = (_PROFILES / f"{pace}.xml").read_text(encoding="utf-8")
    transport = _TRANSPORT.format(interface=interface.translate(_ESCAPED))
    return profile.replace("  <participant ", f"{transport}  <participant ", 1).replace(
        "    <rtps>\n", f"    <rtps>\n{_ONLY_TRANSPORT}", 1
    )


@contextlib.contextmanager
def _changed(environment: MutableMapping[str, str], added: Mapping[str, str]) -> Iterator[None]:
    former = {name: environment[name] for name in added if name in environment}
    environment.update(added)
    try:
        yield
    finally:
        for variable in added:
            del environment[variable]
        environment.update(former)
