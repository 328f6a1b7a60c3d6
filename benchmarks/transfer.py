"""Time to transfer a directory from one process to another.

Half of each file is random and half is empty, like typical memory. Everything is on loopback: both
ends, TLS, compression and checksums share the machine, so a network faster than `mb_per_s` gains
nothing. Medians of the rounds for each size: `offer_s` until the source is ready, `fetch_s` from
then until the directory is in its place, both with processes that were started in advance; `cold_s`
for everything with processes that are started on demand; `wire_mb`: bytes on the network.
`peak_mib` is the largest memory of any of these processes.
"""

from __future__ import annotations

import random
import resource
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks.machine import parser, print_report, say
from benchmarks.stopping import run
from rosrm_criu.transfer import Fetcher, Sender

SIZES_MB = (10, 100, 500)
#: Number of random bytes, followed by as many zeros.
GRAIN = 2048
#: Seconds in which a process has loaded its libraries, on a busy machine too.
LOADING = 3.0


def fill(directory: Path, megabytes: int) -> None:
    """Write files of 25 MB at most."""
    chance = random.Random(megabytes)  # noqa: S311 - any bytes will do
    left = megabytes * 1_000_000
    while left:
        size = min(left, 25_000_000)
        grains = (chance.randbytes(GRAIN) + bytes(GRAIN) for _ in range(size // (2 * GRAIN) + 1))
        (directory / f"pages-{left}.img").write_bytes(b"".join(grains)[:size])
        left -= size


def moved(source: Path, target: Path, *, ahead: bool) -> dict[str, float]:
    """Return the figures of one transfer."""
    begun = time.perf_counter()
    with Sender() as sender, Fetcher() as fetcher:
        to = fetcher.introduce()
        if ahead:
            time.sleep(LOADING)
            begun = time.perf_counter()
        offer = sender.offer(source, seconds=600.0, max_rate=0, to=to)
        offered = time.perf_counter()
        fetched = fetcher.fetch(offer, target, timeout=600.0)
        whole = time.perf_counter() - begun
        sent = sender.wait(60.0)
    if sent is None or sent.outcome != "taken":
        raise SystemExit(f"the source says {sent}")
    if not ahead:
        return {"cold_s": whole}
    return {
        "offer_s": offered - begun,
        "fetch_s": fetched.seconds,
        "mb_per_s": fetched.size / 1e6 / fetched.seconds,
        "wire_mb": fetched.received / 1e6,
    }


def measured(megabytes: int, rounds: int) -> dict[str, float]:
    """Return the figures of one size."""
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as directory:
        source = Path(directory, "source")
        source.mkdir()
        fill(source, megabytes)
        for number in range(2 * rounds):
            target = Path(directory, f"target-{number}")
            for name, value in moved(source, target, ahead=number % 2 == 0).items():
                found.setdefault(name, []).append(value)
            for file in target.iterdir():
                file.unlink()
    return {name: round(median(values), 4) for name, values in found.items()}


def main() -> None:
    command_line = parser(__doc__)
    command_line.add_argument(
        "--sizes",
        type=int,
        nargs="+",
        default=list(SIZES_MB),
        metavar="MB",
        help="MB of each directory",
    )
    command_line.add_argument(
        "--rounds", type=int, default=5, help="transfers of each size and kind"
    )
    options = command_line.parse_args()
    table = {}
    for megabytes in options.sizes:
        table[str(megabytes)] = measured(megabytes, options.rounds)
        say(f"{megabytes} MB: {table[str(megabytes)]}")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print_report("transfer", {"by_size_mb": table, "peak_mib": round(peak, 1)}, runs=options.rounds)


if __name__ == "__main__":
    sys.exit(run("transfer", main))
