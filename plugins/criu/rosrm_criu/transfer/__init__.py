"""Moves a directory of files from one host to another: over TLS, compressed, checked, once.

Knows nothing of what is in the files. The source *offers* a directory: a process of its own serves
it to the destination that was introduced, until it was taken or its time is over; nothing listens
before and afterwards. The destination *fetches* it by that offer, in a process of its own too, so
that neither a slave's memory nor its loop has anything of it. Both take and give JSON.

    fetcher = Fetcher()                                       # at the destination, ahead of time
    to = fetcher.introduce()                                  # goes by the master
    sender = Sender()                                         # at the source, ahead of time too
    offer = sender.offer(directory, seconds=60.0, to=to)      # as_json() goes by the master
    fetched = fetcher.fetch(Offer.from_json(told), target, timeout=30.0)
    sender.close()

docs/decisions/0025-image-transfer.md says why it is as it is.
"""

from rosrm_criu.transfer.form import Fetched, Offer, Sent
from rosrm_criu.transfer.starting import DEFAULT_RATE, DEFAULT_RESERVE, Fetcher, Sender, missing

__all__ = [
    "DEFAULT_RATE",
    "DEFAULT_RESERVE",
    "Fetched",
    "Fetcher",
    "Offer",
    "Sender",
    "Sent",
    "missing",
]
