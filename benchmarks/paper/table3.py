"""Table III: SLAM in ten pieces on one host, on ten hosts placed by hand, on ten hosts by rosrm.

Every host has the same CPU quota. In all cases a master and the slaves of all hosts run, outside
the quotas; they are idle in the cases without rosrm. Each case is measured several times, by turns.
"""

from __future__ import annotations

import statistics
import subprocess
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import say
from benchmarks.paper import pictures
from benchmarks.paper.labs import ROOT, Failed, LabCluster
from benchmarks.paper.report import Options, Result
from benchmarks.paper.settings import TABLE3_MIN, alike
from benchmarks.paper.slam import PIECES, Piece, drives_at_hand, pieces_of, scans_mapped
from benchmarks.paper.trace import Look, Trace, per_host
from rosrm_lab import MIB, uniform

CLAIM: Final = (
    "rosrm takes at most 1.05 times as long as the ideal placement by hand, gives each host one "
    "piece, and is several times as fast as one host (by a third of the number of hosts at least)"
)
_MOST_RATIO: Final = 1.05
#: Least speed-up over one host, as a fraction of the number of hosts: they must work in parallel.
_LEAST_SPEED_UP: Final = 1 / 3
#: Cores of each host: ten of them, with the slaves and the master, fit on two.
_CPU: Final = 0.17
_MEMORY: Final = 512 * MIB
#: Seconds after which a case is given up.
_LONGEST: Final = 1500.0
_PAUSE: Final = 1.0
_FEW_PIECES, _FEW_CPU, _SHORT = 3, 0.4, "street:18"


class Cases:
    """The three cases on the same hosts.

    Args:
        cluster: with all slaves up.
        hosts: names.
        pieces: as many as hosts.
        out: folder for results.
    """

    def __init__(
        self, cluster: LabCluster, hosts: Sequence[str], pieces: Sequence[Piece], out: Path
    ) -> None:
        self._cluster = cluster
        self._hosts = hosts
        self._pieces = pieces
        self._out = out

    def one_host(self, run: int) -> float:
        """Map one piece after the other on the first host; return the seconds."""
        out = self._out / f"one{run}"
        began = time.monotonic()
        for piece in self._pieces:
            self._map([(self._hosts[0], piece)], out)
        return self._checked(time.monotonic() - began, out)

    def ideal(self, run: int) -> float:
        """Map each piece on a host of its own, all at once, without rosrm; return the seconds."""
        out = self._out / f"ideal{run}"
        began = time.monotonic()
        self._map(list(zip(self._hosts, self._pieces, strict=True)), out)
        return self._checked(time.monotonic() - began, out)

    def _map(self, placed: Sequence[tuple[str, Piece]], out: Path) -> None:
        started = [
            self._cluster.lab.popen(
                host,
                piece.command(out),
                cwd=str(ROOT),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            for host, piece in placed
        ]
        try:
            codes = [process.wait(_LONGEST) for process in started]
        finally:
            for process in started:
                process.kill()
        if any(codes):
            raise Failed(f"mapping by hand ended with exit codes {codes}")

    def by_rosrm(self, run: int) -> tuple[float, dict[str, Any]]:
        """Submit all pieces at once; return the seconds to the last end, and their parts."""
        out = self._out / f"rosrm{run}"
        entries = [piece.entry(out, ROOT) for piece in self._pieces]
        for entry in entries:
            entry["name"] += f"_run{run}"
        names = {entry["name"] for entry in entries}
        began = time.time()
        self._cluster.submit(*entries)

        def over(look: Look) -> bool:
            return all(look.states.get(name) == "finished" for name in names)

        # Polled seldom, because the other cases run without polling.
        self._cluster.wait_until("all pieces mapped", over, _LONGEST, every=_PAUSE)
        times = _times(self._cluster.trace, names, began)
        seconds = self._checked(max(times["finished"].values()), out)
        return seconds, _spent(self._cluster.trace, names, times)

    def _checked(self, seconds: float, out: Path) -> float:
        scans_mapped(self._pieces, out)  # raises where a result is missing
        time.sleep(_PAUSE)  # the kernel grants quotas by the period: begin with fresh ones
        return seconds


def _times(trace: Trace, names: set[str], began: float) -> dict[str, dict[str, float]]:
    """Return the seconds from `began` (unix time) to the last event, by kind and process."""
    found: dict[str, dict[str, float]] = {kind: {} for kind in ("assigned", "starting", "finished")}
    for event in trace.of_kind(*found):
        if event.process in names:
            found[event.kind][event.process] = event.wall_time - began
    return found


def _spent(trace: Trace, names: set[str], times: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Return the parts of the time, and the number of pieces of each host."""
    assigned = [event for event in trace.placed() if event.process in names]
    ends, starts = times["finished"], times["starting"]
    return {
        "last_assigned_s": round(max(times["assigned"].values()), 3),
        "last_started_s": round(max(starts.values(), default=0.0), 3),
        "longest_piece_s": round(max(ends[name] - starts.get(name, 0.0) for name in ends), 2),
        "per_host": per_host(assigned),
    }


def measure(options: Options) -> Result:
    """Measure the three cases by turns."""
    drives = options.drives or ((_SHORT,) if options.small else drives_at_hand())
    pieces = pieces_of(drives, _FEW_PIECES if options.small else PIECES)
    cpu = _FEW_CPU if options.small else _CPU
    plans = uniform(len(pieces), memory=_MEMORY, cpu=cpu, disk=64 * MIB)
    hosts = [plan.name for plan in plans]
    seconds: dict[str, list[float]] = {"one_host": [], "ideal": [], "rosrm": []}
    spent = []
    with LabCluster(f"{options.lab}-table3", plans, options.folder) as cluster:
        for host in hosts:
            cluster.start_slave_beside(host)
        cluster.wait_for_slaves(hosts)
        cluster.check_supervisors(hosts)
        say(f"table3: {len(hosts)} slaves are up; {', '.join(drives)} in {len(pieces)} pieces")
        cluster.begin()
        cases = Cases(cluster, hosts, pieces, options.folder / "pieces")
        for run in range(options.runs):
            for case, measured in (("ideal", cases.ideal), ("one_host", cases.one_host)):
                seconds[case].append(measured(run))
                say(f"table3: run {run + 1}: {case} {seconds[case][-1]:.1f} s")
            took, where = cases.by_rosrm(run)
            seconds["rosrm"].append(took)
            spent.append(where)
            say(f"table3: run {run + 1}: rosrm {took:.1f} s")
    wrong, figures = judge(seconds, spent, len(hosts))
    figures |= {"drives": list(drives), "pieces": len(pieces), "cores_per_host": cpu}
    scaled = {
        "job": f"{', '.join(drives)} instead of 1 km, in {len(pieces)} pieces; on one host one "
        "piece after the other",
        "hosts": f"{alike(plans)}, for all at once must fit on its cores",
    }
    return Result(wrong, figures, scaled, partial(_draw, figures), options.runs, cluster.records)


def judge(
    seconds: dict[str, list[float]], spent: Sequence[dict[str, Any]], hosts: int
) -> tuple[list[str], dict[str, Any]]:
    """Return the objections to the claim, and the numbers.

    Args:
        seconds: of each run, by case.
        spent: parts of the time of the runs by rosrm.
        hosts: how many.
    """
    middle = {case: statistics.median(runs) for case, runs in seconds.items()}
    ratio = middle["rosrm"] / middle["ideal"]
    wrong = []
    if ratio > _MOST_RATIO:
        wrong.append(f"rosrm takes {ratio:.3f} times as long as the ideal, more than {_MOST_RATIO}")
    if middle["one_host"] < middle["rosrm"] * hosts * _LEAST_SPEED_UP:
        wrong.append(
            f"{hosts} hosts are only {middle['one_host'] / middle['rosrm']:.1f} times as fast"
        )
    crowded = [one["per_host"] for one in spent if max(one["per_host"].values()) > 1]
    if crowded:
        wrong.append(f"pieces shared a host: {crowded}")
    return wrong, {
        **{f"{case}_s": round(value, 2) for case, value in middle.items()},
        "ratio": round(ratio, 4),
        "speed_up": round(middle["one_host"] / middle["rosrm"], 2),
        "all_s": {case: [round(one, 2) for one in runs] for case, runs in seconds.items()},
        "rosrm_spent": list(spent),
        "paper_ratio": round(TABLE3_MIN["rosrm"] / TABLE3_MIN["ideal"], 2),
        "paper_speed_up": round(TABLE3_MIN["one_host"] / TABLE3_MIN["rosrm"], 1),
        "paper_min": TABLE3_MIN,
    }


def _draw(figures: dict[str, Any], path: Path) -> None:
    words = {
        "One host": "one_host_s",
        "10 hosts (ideal case)": "ideal_s",
        "10 hosts (with rosrm)": "rosrm_s",
    }
    pictures.execution_times(path, {name: figures[key] for name, key in words.items()})
