"""rosrm, Ray, Dask, Slurm and a bare loop with the same work on this machine, in turn.

In each round each system runs, in an environment of its own: `date`, which prints the time as
its first action, one after the other; 300 times `true` at once; 150 times `sleep 0.1` on three
slots; 60 processes of 40 MB at once. Ray and Dask are installed into out/peers/ on the first run.
They keep their state in memory; rosrm writes each job to its journal before it starts. Slurm takes
part where its programs are installed and the user is root.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import venv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import which
from typing import Any, Final

from benchmarks.machine import parser, percentile, print_report, say
from benchmarks.stopping import run
from rosrm.errors import RosrmError

ROOT: Final = Path(__file__).resolve().parents[2]
#: Seconds for one measurement, with the start and the end of the measured system.
_LONGEST: Final = 600.0
#: Processes of each measurement, as named in the docs.
_COUNTS: Final = {"stamps": 100, "jobs": 300, "sleeps": 150, "holders": 60}
#: Programs of Slurm that its runner starts.
_SLURM: Final = ("munged", "slurmctld", "slurmd", "salloc", "squeue", "sinfo", "srun")


@dataclass(frozen=True)
class Peer:
    """A system in the comparison.

    Attributes:
        name: as in the result.
        python: of its environment.
        version: of its distribution; "": it has none.
    """

    name: str
    python: str
    version: str = ""


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=4, help="rounds")
    command_line.add_argument(
        "--environments", type=Path, default=ROOT / "out" / "peers", metavar="DIR",
        help="folder for the environments of Ray and Dask",
    )  # fmt: skip
    command_line.add_argument(
        "--measurements", nargs="+", choices=sorted(_COUNTS), default=list(_COUNTS)
    )
    options = command_line.parse_args()
    peers = [
        Peer("bare", sys.executable),
        Peer("rosrm", sys.executable),
        installed("ray", "ray", options.environments),
        installed("dask", "distributed", options.environments),
    ]
    left_out = {"slurm": why} if (why := why_no_slurm()) else {}
    if not left_out:
        peers.append(Peer("slurm", sys.executable, slurm_version()))
    found: dict[str, dict[str, list[Any]]] = {
        name: {peer.name: [] for peer in peers} for name in options.measurements
    }
    for round_number in range(options.runs):
        for name in options.measurements:
            for peer in _rotated(peers, round_number):
                say(f"peers: round {round_number + 1} of {options.runs}: {name} of {peer.name}")
                found[name][peer.name].append(measured(peer, name, _COUNTS[name]))
    figures = figures_of(found)
    figures["peer_versions"] = {peer.name: peer.version for peer in peers if peer.version}
    figures["left_out"] = left_out
    print_report("peers", figures, runs=options.runs)


def _rotated(peers: Sequence[Peer], by: int) -> Sequence[Peer]:
    first = by % len(peers)
    return [*peers[first:], *peers[:first]]


def measured(peer: Peer, measurement: str, count: int) -> Any:
    """Run one measurement in a process of its own; return its result.

    Raises:
        RosrmError: the measurement failed.
    """
    module = f"benchmarks.peers.run_{peer.name}"
    command = [peer.python, "-m", module, measurement, "--count", str(count)]
    try:
        ended = subprocess.run(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True,
            timeout=_LONGEST, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise RosrmError(f"{peer.name}: {measurement} took more than {_LONGEST:g} s") from None
    if ended.returncode:
        raise RosrmError(f"{peer.name}: {measurement} failed:\n{ended.stderr.strip()[-2000:]}")
    return json.loads(ended.stdout.splitlines()[-1])


def installed(name: str, distribution: str, environments: Path) -> Peer:
    """Return a peer with its environment, which is made on the first call.

    Raises:
        RosrmError: it cannot be installed.
    """
    place = environments / name
    python = place / "bin" / "python"
    if not python.exists() or not _version(python, distribution):
        say(f"peers: installing {distribution} into {place}")
        venv.create(place, with_pip=True, clear=True)
        ended = subprocess.run(
            [python, "-m", "pip", "install", "--quiet", distribution], stdin=subprocess.DEVNULL,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if ended.returncode:
            raise RosrmError(f"pip install {distribution} failed:\n{ended.stderr.strip()[-2000:]}")
    return Peer(name, str(python), _version(python, distribution))


def _version(python: Path, distribution: str) -> str:
    """Return the version of a distribution in an environment; "": it is not installed."""
    program = f"import importlib.metadata as m; print(m.version({distribution!r}))"
    ended = subprocess.run(
        [python, "-c", program], stdin=subprocess.DEVNULL, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    return ended.stdout.strip()


def why_no_slurm() -> str:
    """Return why Slurm cannot be measured here; "": it can."""
    missing = [name for name in _SLURM if which(name) is None]
    if missing:
        return f"{', '.join(missing)}: not found; `apt-get install slurm-wlm munge` has them"
    return "" if os.geteuid() == 0 else "its daemons need root"


def slurm_version() -> str:
    """Return the version of the installed Slurm."""
    ended = subprocess.run(["slurmd", "-V"], capture_output=True, text=True, check=True)
    return ended.stdout.split()[-1]


def figures_of(found: Mapping[str, Mapping[str, Sequence[Any]]]) -> dict[str, Any]:
    """Return the figures of all rounds: medians of the rounds.

    Args:
        found: by measurement and peer, a result for each round.
    """
    figures: dict[str, Any] = {}
    if "stamps" in found:
        figures.update(_beyond_spawn(found["stamps"]))
    for measurement, name in (
        ("jobs", "jobs_per_s"), ("sleeps", "makespan_over_ideal"), ("holders", "holders_s")
    ):  # fmt: skip
        for peer, rounds in found.get(measurement, {}).items():
            figures.setdefault(name, {})[peer] = round(statistics.median(rounds), 4)
            figures.setdefault(f"{name}_all", {})[peer] = [round(one, 4) for one in rounds]
    return figures


def _beyond_spawn(stamps: Mapping[str, Sequence[Sequence[float]]]) -> dict[str, Any]:
    """Return median and 99th percentile beyond the median of the bare spawn of the same round."""
    bare = [statistics.median(one) for one in stamps["bare"]]
    figures: dict[str, Any] = {"spawn_ms": round(statistics.median(bare), 3)}
    for name, fraction in (("beyond_spawn_ms", 0.5), ("beyond_spawn_p99_ms", 0.99)):
        beyond = {
            peer: [
                round(percentile(one, fraction) - spawn, 3)
                for one, spawn in zip(rounds, bare, strict=True)
            ]
            for peer, rounds in stamps.items()
            if peer != "bare"
        }
        figures[name] = {peer: statistics.median(rounds) for peer, rounds in beyond.items()}
        figures[f"{name}_all"] = beyond
    return figures


if __name__ == "__main__":
    sys.exit(run("peers", main))
