"""Tickets: permission to send requests of one kind to a slave, without the key of its host.

The master sends the bearer the text of a ticket, and a key that is derived from the key of the
slave's host and that text. Each request contains the text, and the slave derives the same key from
that text. So the master sends nothing to the slave. The slave stores a ticket only after a genuine
request with it.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from rosrm.errors import ConfigError
from rosrm.keys.derivation import derived
from rosrm.keys.roles import Principal, principal_of

#: Seconds for which a ticket is valid.
TICKET_LIFE: Final = 60.0

_PREFIX: Final = "ticket:"
_NUMBER: Final = re.compile(r"[0-9]{1,20}")
_LIFE_NS: Final = int(TICKET_LIFE * 1e9)


class Ticket(NamedTuple):
    """Permission for requests to one service of one slave.

    Attributes:
        until: time of the slave's boot clock at which the ticket expires, ns.
        version: version of the master's keys at which the master made the ticket. When a key is
            revoked, tickets of earlier versions become invalid.
        service: name of the slave's service, for example "read_log".
        first: lowest number of an instance whose logs may be read. Instances of lower numbers
            belonged to another owner of the name.
        process: name of the only process that requests with the ticket may concern.
        bearer: the principal to which the master gave the ticket.
    """

    until: int
    version: int
    service: str
    first: int
    process: str
    bearer: Principal

    def is_valid(self, now: int, beat_at: int) -> bool:
        """Return True if a ticket has not expired.

        While the master is away, no bearer can get another ticket. So a ticket that was valid at
        the master's newest beat is valid until the next one; otherwise slaves would send no more
        replicas of snapshots.

        The slave's clock begins again when the host boots. So a ticket that expires later than
        `TICKET_LIFE` from now is from before the last boot, and is invalid.

        Args:
            now: time of the slave's clock, ns.
            beat_at: time of the master's newest beat by that clock, ns.
        """
        return beat_at <= self.until <= now + _LIFE_NS

    def text(self) -> str:
        """Return the ticket as text for messages."""
        numbers = f"{self.until}:{self.version}:{self.service}:{self.first}"
        return f"{_PREFIX}{numbers}:{self.process}:{self.bearer}"

    def key(self, host_key: bytes) -> bytes:
        """Return the key of the bearer, from the key of the slave's host."""
        return derived(host_key, "ticket", self.text())


def ticket_of(text: str) -> Ticket | None:
    """Return the ticket that a text describes; None if the text is no ticket.

    Each ticket has exactly one valid text, because the counters of messages are stored by text.
    With a second text, such as "007" for 7, anyone could send recorded messages again.
    """
    until, _, rest = text.removeprefix(_PREFIX).partition(":")
    version, _, rest = rest.partition(":")
    service, _, rest = rest.partition(":")
    first, _, rest = rest.partition(":")
    process, _, bearer = rest.partition(":")
    are_numbers = all(_NUMBER.fullmatch(one) for one in (until, version, first))
    if not (text.startswith(_PREFIX) and are_numbers):
        return None
    try:
        ticket = Ticket(
            int(until), int(version), service, int(first), process, principal_of(bearer)
        )
    except ConfigError:
        return None
    return ticket if ticket.text() == text else None
