"""Introductions: the master gives a slave or client a ticket for the slave of another host.

See `rosrm.keys.tickets`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from rosrm.keys.security import Authority, Member, Peer
from rosrm.ros.control import check_answer
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv

#: Seconds after which the bearer of a ticket requests a new one.
_RENEWED_AFTER: Final = 40.0


def ticket_version(epoch: int, security: Authority) -> int:
    """Return the version of the master's tickets, which increases when keys change."""
    return (epoch & 0xFFFFFFFF) << 32 | security.tickets_from


class Introduction(NamedTuple):
    """The slave of another host, for which this part has a ticket.

    Attributes:
        slave: receiver of the requests.
        until: monotonic seconds, at which a new ticket is due.
    """

    slave: Peer
    until: float


def introduction_request(host: str, service: str, process: str) -> srv.Introduce.Request:
    """Return the request to the master for a ticket."""
    return srv.Introduce.Request(
        protocol_version=PROTOCOL_VERSION, host=host, service=service, process=process
    )


def introduction_of(
    response: srv.Introduce.Response, security: Member, asked_at: float
) -> Introduction:
    """Return the introduction in the master's response; raise `Refused` if it is a refusal.

    Args:
        response: of the master.
        security: of this part.
        asked_at: monotonic seconds at which the request was sent.
    """
    check_answer(response.answer, "the master")
    slave = security.bearer(response.ticket, bytes(response.key), bytes(response.run))
    return Introduction(slave, asked_at + _RENEWED_AFTER)
