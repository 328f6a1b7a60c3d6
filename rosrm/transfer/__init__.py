"""Moves a directory of files from one host to another: over TLS, compressed, checked, once.

Knows nothing of what is in the files. The source *offers* a directory: a process of its own serves
it to whoever brings the offer's token, until it was taken or its time is over; nothing listens
before and afterwards. The destination *fetches* it by that offer, in a process of its own too, so
that neither a slave's memory nor its loop has anything of it. Both take and give JSON.

    sender = Sender()                                              # at the source
    offer = sender.offer(directory, seconds=60.0)                  # as_json() goes by the master
    fetched = fetch(Offer.from_json(told), target, timeout=30.0)   # at the destination
    sender.close()                                                 # at the source

docs/decisions/0025-image-transfer.md says why it is as it is.
"""

from rosrm.transfer.form import Fetched, Offer, Sent
from rosrm.transfer.starting import DEFAULT_RATE, DEFAULT_RESERVE, Fetcher, Sender, fetch, missing

__all__ = [
    "DEFAULT_RATE",
    "DEFAULT_RESERVE",
    "Fetched",
    "Fetcher",
    "Offer",
    "Sender",
    "Sent",
    "fetch",
    "missing",
]
