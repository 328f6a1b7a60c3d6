"""Comparison of the observations with the paper's claims. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from benchmarks.paper.trace import HostLook, Look, Move, Trace
from rosrm.core.master.state.host_arrays import FloatArray

#: Fraction of a host's memory by which readings of different hosts and moments may disagree.
NOISE: Final = 0.01


@dataclass(frozen=True)
class Line:
    """A straight line through points, by least squares.

    Attributes:
        r2: part of the variance that it explains, 0..1.
    """

    slope: float
    intercept: float
    r2: float


def line(x: Sequence[float], y: Sequence[float]) -> Line:
    """Return the line through points; raises `ValueError` for fewer than two different x."""
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    if len(set(x)) < 2 or len(xs) != len(ys):
        raise ValueError(f"a line needs two points at least: x {list(x)}, y {list(y)}")
    slope, intercept = np.polyfit(xs, ys, 1)
    return _explained(xs, ys, float(slope), float(intercept))


def proportion(x: Sequence[float], y: Sequence[float]) -> Line:
    """Return the line through points and the origin; raises `ValueError` where all x are 0."""
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    if not xs.any() or len(xs) != len(ys):
        raise ValueError(f"a proportion needs a point beside 0: x {list(x)}, y {list(y)}")
    return _explained(xs, ys, float(xs @ ys / (xs @ xs)), 0.0)


def _explained(xs: FloatArray, ys: FloatArray, slope: float, intercept: float) -> Line:
    left = float(((ys - slope * xs - intercept) ** 2).sum())
    all_of_it = float(((ys - ys.mean()) ** 2).sum())
    return Line(slope, intercept, 1.0 - left / all_of_it if all_of_it > 0.0 else 0.0)


def gap(look: Look, hosts: Sequence[str]) -> float | None:
    """Return fullest minus emptiest of some hosts, fraction; None: one is absent or not known."""
    seen = [look.hosts[name].usage for name in hosts if name in look.hosts]
    usages = [usage for usage in seen if usage is not None]
    return max(usages) - min(usages) if len(usages) == len(hosts) else None


def widest_gap(trace: Trace, hosts: Sequence[str], begin: float = 0.0) -> float:
    """Return the largest gap from a moment (s of the master's clock) on; 0: there was none."""
    gaps = (gap(look, hosts) for look in trace.looks if look.elapsed >= begin)
    return max((one for one in gaps if one is not None), default=0.0)


def not_to_emptiest(
    trace: Trace, needs: Mapping[str, float], tolerance: float = 2 * NOISE
) -> list[str]:
    """Return the assignments that did not go to the host with the largest margin, as sentences.

    The usage of a host is computed independently of rosrm: the usage at its first reading, and the
    needs of all processes assigned to it since. Valid for processes that stay, and whose usage
    equals their needs.

    Args:
        trace: of the run; hosts of equal limits.
        needs: bytes by process.
        tolerance: fraction by which the chosen host may have been fuller.
    """
    wrong = []
    held: dict[str, dict[str, float]] = {}
    first = first_looks(trace)
    for event in trace.of_kind("assigned"):
        for others in held.values():  # an assignment that the slave did not take is repeated
            others.pop(event.process, None)
        loads = {
            name: (host.usage or 0.0) + sum(held.get(name, {}).values()) / host.capacity
            for name, (at, host) in first.items()
            if at < event.elapsed
        }
        emptiest = min(loads, key=lambda name: loads[name], default=event.host)
        if loads.get(event.host, 0.0) > loads.get(emptiest, 0.0) + tolerance:
            wrong.append(
                f"{event.process} went to {event.host} at {100 * loads[event.host]:.1f} % while "
                f"{emptiest} was at {100 * loads[emptiest]:.1f} %"
            )
        held.setdefault(event.host, {})[event.process] = needs[event.process]
    return wrong


def first_looks(trace: Trace) -> dict[str, tuple[float, HostLook]]:
    """Return the first look (s of the master's clock) at which each host requested work."""
    first: dict[str, tuple[float, HostLook]] = {}
    for look in trace.looks:
        for name, host in look.hosts.items():
            if name not in first and host.usage is not None and host.accepting:
                first[name] = (look.elapsed, host)
    return first


def room_left(look: Look, need: float, limit: float) -> list[str]:
    """Return the hosts with room for one more process of `need` bytes under the limit."""
    return [
        name
        for name, host in look.hosts.items()
        if host.usage is not None and host.load + need / host.capacity < limit - NOISE
    ]


def over(trace: Trace, limit: float) -> dict[str, float]:
    """Return the highest usage of each host that exceeded a limit by more than the noise."""
    peaks: dict[str, float] = {}
    for look in trace.looks:
        for name, host in look.hosts.items():
            if host.usage is not None and host.usage > limit + NOISE:
                peaks[name] = max(peaks.get(name, 0.0), host.usage)
    return peaks


def peak(trace: Trace) -> float:
    """Return the highest usage of any host, fraction."""
    looks = (host.usage for look in trace.looks for host in look.hosts.values())
    return max((usage for usage in looks if usage is not None), default=0.0)


def wrong_move(look: Look, move: Move, need: float, limit: float, headroom: float) -> str:
    """Return the error of a migration, by the last look before it; "": none.

    The source must have reached the limit. Of the hosts with room for the process, the destination
    must have the largest margin.

    Args:
        look: at the cluster, right before.
        move: the migration.
        need: bytes for which the destination must have room.
        limit: of each host, fraction.
        headroom: by which a destination stays under the limit, fraction.
    """
    source = look.hosts[move.source]
    if source.usage is None or source.usage < limit - NOISE:
        return f"{move.process} left {move.source} although it was not at its limit"
    loads = {name: host.load for name, host in look.hosts.items() if name != move.source}
    fits = {
        name: load
        for name, load in loads.items()
        if load + need / look.hosts[name].capacity <= limit - headroom + 2 * NOISE
    }
    if move.destination not in fits:
        return f"{move.process} went to {move.destination}, which had no room for it"
    emptiest = min(fits, key=lambda name: fits[name])
    if fits[move.destination] > fits[emptiest] + 2 * NOISE:
        return f"{move.process} went to {move.destination}; {emptiest} had the larger margin"
    return ""
