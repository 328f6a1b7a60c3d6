"""Process of one transfer: `python -m rosrm_criu.transfer send` or `… fetch`.

It reads a line of JSON from standard input, works, and answers with lines of JSON on standard
output. An optional first request asks whether it is ready. Before a fetch, another one asks for the
certificate that it will show. It ends when standard input does, so it outlives neither its work nor
its parent.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rosrm import threads
from rosrm.errors import TransferError
from rosrm.runtime.signalling import send
from rosrm_criu.transfer.form import Offer


def main() -> int:
    """Execute the request; return 0 on success and 1 on failure."""
    os.umask(0o077)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is meant for the parent
    work = {"send": _send, "fetch": _fetch}[sys.argv[1]]
    # Import early: a process that is started in advance has its libraries when work arrives.
    if sys.argv[1] == "send":
        import rosrm_criu.transfer.sending  # noqa: PLC0415
    else:
        import rosrm_criu.transfer.receiving  # noqa: F401, PLC0415
    line = sys.stdin.readline()
    if line and json.loads(line) == {"ready": True}:
        _say({})
        line = sys.stdin.readline()
    if not line:
        return 0
    try:
        _say(work(json.loads(line)))
    except TransferError as error:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the parent ends this after the error
        _say({"error": str(error)})
        return 1
    return 0


def _say(answer: Mapping[str, Any]) -> None:
    try:
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os._exit(1)  # the parent has gone and reads no answer


def _send(asked: dict[str, Any]) -> Mapping[str, Any]:
    from rosrm_criu.transfer.sending import serve  # noqa: PLC0415

    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    _when_input_ends(over.set)
    directory = Path(asked.pop("directory"))
    return asdict(serve(directory, **asked, over=over, announce=lambda one: _say(one.as_json())))


def _fetch(asked: dict[str, Any]) -> Mapping[str, Any]:
    from rosrm_criu.transfer.certificate import new_identity  # noqa: PLC0415
    from rosrm_criu.transfer.receiving import receive  # noqa: PLC0415

    def stop(*_: object) -> None:
        ignore()
        raise TransferError("the fetch was stopped before everything was received")

    def ignore() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    signal.signal(signal.SIGTERM, stop)
    if "introduce" not in asked:
        raise TransferError("the destination was not introduced: the source would refuse it")
    identity = new_identity()
    _say({"certificate": identity.certificate})
    line = sys.stdin.readline()
    if not line:
        raise TransferError("the fetch was stopped before it began")
    asked = json.loads(line)
    _when_input_ends(lambda: send(os.getpid(), signal.SIGTERM))
    offer, target = Offer.from_json(asked.pop("offer")), Path(asked.pop("target"))
    return asdict(receive(offer, target, **asked, identity=identity, before_placing=ignore))


def _when_input_ends(do: Callable[[], object]) -> None:
    """Call a function, in another thread, when the parent closes the standard input or ends."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        do()

    threads.start(wait, "input")


if __name__ == "__main__":
    sys.exit(main())
