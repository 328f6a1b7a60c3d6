"""Transfer of a directory from one host to another: one TLS stream, compressed and checksummed.

The contents of the files do not matter here. The source *offers* a directory: a separate process
serves it to one known destination, until it is fetched or the offer expires; no port is open before
and afterwards. The destination *fetches* it by that offer, also in a separate process, so that the
transfer affects neither a slave's memory nor its event loop. Both sides use JSON.

    fetcher = Fetcher()                                       # at the destination, ahead of time
    to = fetcher.introduce()                                  # sent via the master
    sender = Sender()                                         # at the source, ahead of time too
    offer = sender.offer(directory, seconds=60.0, to=to)      # as_json() is sent via the master
    fetched = fetcher.fetch(Offer.from_json(told), target, timeout=30.0)
    sender.close()

If the stream breaks, the fetch fails, both sides remove what they have, and the offer is over.
docs/decisions/0041-one-tls-stream.md gives the reasons for this design.
"""

from rosrm_criu.transfer.form import Fetched, Offer, OfferResult
from rosrm_criu.transfer.starting import DEFAULT_RATE, DEFAULT_RESERVE, Fetcher, Sender, missing

__all__ = [
    "DEFAULT_RATE",
    "DEFAULT_RESERVE",
    "Fetched",
    "Fetcher",
    "Offer",
    "OfferResult",
    "Sender",
    "missing",
]
