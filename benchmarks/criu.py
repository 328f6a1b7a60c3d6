"""Outputs of a node that migrates with its whole memory, by CRIU, at an external observer.

A lab of three hosts with addresses of their own: master and observer on one, and a counter that
migrates to and fro between the two others (`rosrm_examples.portable_counter`, 50 Hz), with a heap
of 10, 100 and 500 MB (--heaps). Blackout: from the last count received before a migration to the
first one after it. The node writes 1 % of its heap each second (--write), and
reads the whole heap at least once after each migration. For comparison the same counter, with the
first heap, migrates by `relaunch`, and one whose state is a number by `handoff`.

Exit status: 1 if a migration failed, a cycle was executed twice, or a heap has changed. Needs root,
and a CRIU that works.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import parser, print_report, quantiles, say
from benchmarks.stopping import run
from rosrm.errors import LabError
from rosrm_criu.engine.probe import criu_support
from rosrm_lab import DATA, GIB, HostPlan, Lab, uniform

_ROOT: Final = Path(__file__).resolve().parents[1]
_ROSRM: Final = (sys.executable, "-m", "rosrm.cli")
_HOSTS: Final = ("host1", "host2")
_DESK: Final = "desk"
#: Room for two checkpoint images of the largest heap, and for the reserve of the transfer.
_DISK: Final = 4 * GIB
#: Migrations by each of the other strategies.
_BESIDE: Final = 10
#: Seconds for a part to shut down, and for the client.
_END: Final = 30.0

#: The parts of a migration: executor and name of each one's own seconds.
_PARTS: Final = {
    "prepare": (("criu_checkpoint", "prepare"),),
    "dump": (("criu_checkpoint", "dump"), ("criu_checkpoint", "dump_compared")),
    "transfer": (("criu_checkpoint", "offer"), ("criu_fetch", "transfer")),
    "restore": (("criu_await_restored", "restore"),),
    "rejoin": (("criu_join", "join"),),
}


@dataclass(frozen=True)
class Outcome:
    """The migrations of one heap, with their outcomes.

    Attributes:
        hops: as `benchmarks.criu_desk` prints them.
    """

    hops: Sequence[Mapping[str, Any]]

    @property
    def failures(self) -> list[str]:
        """Return the reasons of failed migrations."""
        return [hop["why"] for hop in self.hops if hop["end"] != "migrated"]

    @property
    def repeated(self) -> int:
        """Return the number of cycles that were executed twice."""
        return sum(hop["repeated"] for hop in self.hops)

    @property
    def heap_ok(self) -> bool:
        """Return True if every read of the memory found the same content."""
        return len({one for hop in self.hops for one in hop["checksums"]}) == 1

    def silences(self) -> list[float]:
        """Return the seconds without a count, for each migration."""
        return [hop["silence"] for hop in self.hops if hop["end"] == "migrated"]

    def part(self, name: str) -> list[float]:
        """Return the seconds of one part, for each migration."""
        return [
            sum(hop["parts"][executor].get(word, 0.0) for executor, word in _PARTS[name])
            for hop in self.hops
            if hop["end"] == "migrated"
        ]

    def figures(self) -> dict[str, Any]:
        """Return all figures."""
        return {
            "hops": len(self.hops), "failures": len(self.failures),
            **quantiles("blackout", self.silences()),
            **{key: value for name in _PARTS for key, value in
               quantiles(name, self.part(name)).items()},
            "heap_ok": self.heap_ok, "repeated": self.repeated,
            "missed": sum(hop["missed"] for hop in self.hops),
        }  # fmt: skip


def shared(hops: int, heaps: Sequence[float]) -> list[int]:
    """Return the number of migrations of each heap: most for the first, which is reported most."""
    others = max(1, hops // (len(heaps) + 2))
    return [max(1, hops - others * (len(heaps) - 1)), *[others] * (len(heaps) - 1)]


# --- the lab ----------------------------------------------------------------------------------


@contextlib.contextmanager
def parts(lab: Lab, folder: Path) -> Iterator[None]:
    """Run the master on the host of the client, and a slave on each other host."""
    settings: dict[str, dict[str, Any]] = {
        _DESK: {
            "name": "criu", "state": f"{DATA}/master",
            "migration": {
                "strategies": {"relaunch": {}, "handoff": {}, "criu": {}}, "automatic": False,
            },
        },
        **{
            # Without cpu: the hosts share the processor, and a busy one would make all refuse work.
            host: {
                "host": host, "state": f"{DATA}/slave", "probes": {"memory": {}, "disk": {}},
                "strategies": {"criu": {"as_root": True}},
            }
            for host in _HOSTS
        },
    }  # fmt: skip
    started = []
    try:
        for host, values in settings.items():
            file = folder / f"{host}.yaml"
            file.write_text(json.dumps(values))  # JSON is YAML too
            command = [*_ROSRM, "master" if host == _DESK else "slave", "--config", str(file)]
            with (folder / f"{host}.log").open("ab") as log:
                started.append(
                    lab.popen(
                        host, command, cwd=str(_ROOT), stdin=subprocess.DEVNULL, stdout=log,
                        stderr=log,
                    )
                )  # fmt: skip
        yield
        for part in reversed(started):  # the slaves first
            part.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                part.wait(_END)
    finally:
        for part in started:
            part.kill()
        for part in started:  # one that cannot end keeps no other alive
            part.wait(_END)


def play(lab: Lab, asked: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield each migration after its end; raise `LabError` if the client fails."""
    command = [sys.executable, "-m", "benchmarks.criu_desk", *map(json.dumps, asked)]
    process = lab.popen(_DESK, command, cwd=str(_ROOT), stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            yield json.loads(line)
    except BaseException:  # the caller takes no more
        process.kill()
        raise
    finally:
        process.stdout.close()
        code = process.wait(_END)
    if code:
        raise LabError(f"the client ended with exit code {code}; its errors are above")


def measure(hops: int, heaps: Sequence[float], write: float) -> list[dict[str, Any]]:
    """Return every hop, of every strategy."""
    asked: list[dict[str, Any]] = [
        {"strategy": "criu", "mb": mb, "hops": number, "write": write}
        for mb, number in zip(heaps, shared(hops, heaps), strict=True)
    ]
    beside = min(_BESIDE, hops)
    asked += [
        {"strategy": name, "mb": heaps[0], "hops": beside} for name in ("relaunch", "handoff")
    ]
    plans = [*uniform(len(_HOSTS), disk=_DISK), HostPlan(_DESK)]
    made: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rosrm-criu-bench-")))
        lab = stack.enter_context(Lab(f"criu-{os.getpid()}", plans))
        stack.enter_context(parts(lab, folder))
        try:
            for hop in play(lab, asked):
                made.append(hop)
                say(_summary(len(made), hop))
        except LabError:
            for log in sorted(folder.glob("*.log")):
                say(f"{log.name}:\n{log.read_text(errors='replace')[-2000:]}")
            raise
    return made


def _summary(number: int, hop: Mapping[str, Any]) -> str:
    how = hop["why"] or f"{hop['silence']:.3f} s of silence"
    return f"{number}: {hop['strategy']} of {hop['mb']:g} MB {hop['end']}: {how}"


# --- the report -------------------------------------------------------------------------------


def beside(hops: Sequence[Mapping[str, Any]], strategy: str) -> dict[str, Any]:
    """Return the costs of another strategy: seconds of silence, and losses."""
    own = [hop for hop in hops if hop["strategy"] == strategy]
    silences = [hop["silence"] for hop in own if hop["end"] == "migrated"]
    return {
        "hops": len(own), "failures": sum(hop["end"] != "migrated" for hop in own),
        **quantiles("silence", silences),
        "state_lost": sum(hop["restarted"] for hop in own),
        "memory": "lost" if strategy == "relaunch" else "not in the state",
    }  # fmt: skip


def table(by_heap: Mapping[str, Mapping[str, Any]], others: Mapping[str, Any]) -> str:
    """Return the figures as a table for a terminal."""
    words = ["", "p50 s", "p99 s", *_PARTS, "lost"]
    rows = [words]
    for mb, found in by_heap.items():
        times = [found[f"{name}_p50_s"] for name in _PARTS]
        rows.append(
            [f"criu {mb} MB", found["blackout_p50_s"], found["blackout_p99_s"], *times, "nothing"]
        )
    for name, found in others.items():
        lost = "count and memory" if found["state_lost"] else "nothing of its state"
        blank = ["-"] * len(_PARTS)
        rows.append([name, found["silence_p50_s"], found["silence_p99_s"], *blank, lost])
    return "\n".join("  ".join(f"{word!s:>10}" for word in row) for row in rows)


def main() -> int:
    """Measure and print one JSON object; return the exit status."""
    os.environ.setdefault("ROSRM_CRIU_PREFIX", str(_ROOT / ".venv/criu"))
    command_line = parser(__doc__)
    command_line.add_argument("--hops", type=int, default=50, help="migrations in all")
    command_line.add_argument(
        "--heaps", type=_heap, nargs="+", default=[10.0, 100.0, 500.0], metavar="MB",
        help="MB of each heap; the figures outside of by_heap_mb are of the first",
    )  # fmt: skip
    command_line.add_argument(
        "--write", type=_share, default=0.01, metavar="SHARE",
        help="share of its heap that the node writes each second, from 0 to 1, e.g. 0.05",
    )  # fmt: skip
    chosen = command_line.parse_args()
    able = criu_support()
    if not able.works:
        say(f"CRIU does not work here: {able.reason}")
        return 2
    hops = measure(max(1, chosen.hops), chosen.heaps, chosen.write)
    moved = [hop for hop in hops if hop["strategy"] == "criu"]
    outcomes = {
        f"{mb:g}": Outcome([hop for hop in moved if hop["mb"] == mb]) for mb in chosen.heaps
    }
    by_heap = {mb: outcome.figures() for mb, outcome in outcomes.items()}
    others = {name: beside(hops, name) for name in ("relaunch", "handoff")}
    first = next(iter(by_heap.values()))
    say(table(by_heap, others))
    failures = [why for outcome in outcomes.values() for why in outcome.failures]
    repeated = sum(outcome.repeated for outcome in outcomes.values())
    heap_ok = all(outcome.heap_ok for outcome in outcomes.values())
    print_report(
        "criu",
        {
            "by_heap_mb": by_heap, "beside": others, "hops": len(moved),
            "failures": len(failures), "reasons": sorted(set(failures)),
            **{key: first[key] for key in ("blackout_p50_s", "blackout_p99_s", "rejoin_p50_s")},
            "heap_ok": heap_ok, "repeated": repeated, "write": chosen.write,
            "criu": able.facts.get("version", ""),
        },
        runs=len(moved),
    )  # fmt: skip
    return 1 if failures or repeated or not heap_ok else 0


def _heap(text: str) -> float:
    try:
        mb = float(text)
    except ValueError:
        mb = math.nan
    if not 0 < mb < 100_000:
        raise argparse.ArgumentTypeError(f"{text} is no number of MB above 0")
    return mb


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = math.nan
    if not 0 <= share <= 1:
        raise argparse.ArgumentTypeError(f"{text} is no share from 0 to 1")
    return share


if __name__ == "__main__":
    sys.exit(run("criu", main))
