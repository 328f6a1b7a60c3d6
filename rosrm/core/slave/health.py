"""Health of ready instances: observations go in, verdicts come out.

A check fails only if every observation for longer than the spec's `timeout` found it failing. Only
time in which the slave observed counts. So a slave that was stopped, or got no CPU, fails no
instance. The rate of a node with simulated time counts by `/clock`: a simulator that is paused, or
slower than real time, fails no instance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Final

from rosrm.core.slave.watches import NoState, Observation, Watch
from rosrm.model.values import Assignment, Health

#: Seconds between two observations.
LOOK_PERIOD: Final = 0.2
#: Window over which a rate is counted: a share of `timeout`, but at least this number of periods.
_WINDOW: Final = 0.25
_PERIODS: Final = 3.0
#: A count may lack this many messages, because the window begins at a random phase.
_SLACK: Final = 1.0
#: Longest time that one observation counts: this share of `timeout`, but at least these seconds.
_STRIDE: Final = 0.25
_LEAST_STRIDE: Final = 1.5 * LOOK_PERIOD


# --- checks -----------------------------------------------------------------------------------


def watch_of(assignment: Assignment) -> Watch | None:
    """Return the health checks of an instance; None: none."""
    wanted = assignment.spec.health
    if wanted.timeout <= 0.0:
        return None
    return Watch(
        wanted,
        _names(wanted.topic, assignment, "rostopic://") if wanted.topic else (),
        _names("~/get_state", assignment, "rosservice://") if wanted.lifecycle else (),
        restarts=assignment.spec.restart.when != "never",
        paused=assignment.on_trial or assignment.inactive,
        parameters=(
            _names("~/get_parameters", assignment, "rosservice://") if wanted.topic else ()
        ),
    )


def _names(name: str, assignment: Assignment, scheme: str) -> tuple[str, ...]:
    """Return absolute names: resolved for the node's visible name, then for its alias, if any."""
    spec = assignment.spec
    nodes = dict.fromkeys((spec.node, assignment.node_name))
    resolved = (resolve(name, spec.namespace, node, spec.remappings, scheme) for node in nodes)
    return tuple(dict.fromkeys(resolved))


def resolve(
    name: str, namespace: str, node: str, remappings: Mapping[str, str], scheme: str
) -> str:
    """Return the absolute name of a topic or service after the remappings, as rcl finds it.

    Args:
        name: absolute, relative to the namespace, or below the node ("~/scan").
        scheme: "rostopic://" or "rosservice://"; a rule with the other scheme does not apply.
    """
    absolute = _absolute(name, namespace, node)
    for source, target in remappings.items():
        before, colon, rest = source.rpartition(":")
        if source.startswith(scheme):
            rest = source.removeprefix(scheme)
        elif "://" in source or source.startswith("__") or (colon and before != node):
            continue  # rule of the other kind, of the node's own name, or of another node
        if _absolute(rest, namespace, node) == absolute:
            return _absolute(target.removeprefix(scheme), namespace, node)
    return absolute


def _absolute(name: str, namespace: str, node: str) -> str:
    inside = f"/{namespace.strip('/')}".rstrip("/")
    if name.startswith("/"):
        return name
    if name == "~" or name.startswith("~/"):
        return f"{inside}/{node}{name[1:]}"
    return f"{inside}/{name}"


# --- judgement --------------------------------------------------------------------------------


class _Lasting:
    """Duration for which a check has failed without a break, since the first failure."""

    __slots__ = ("amiss", "seconds")

    def __init__(self) -> None:
        self.amiss = False
        self.seconds = 0.0

    def note(self, amiss: bool, passed: float) -> None:
        self.seconds = self.seconds + passed if self.amiss and amiss else 0.0
        self.amiss = amiss


class InstanceHealth:
    """The health of one run of an instance.

    Args:
        watch: the checks.
        pid: pid of the run.
        now: time at which the run was ready.

    Attributes:
        pid: pid of the run.
    """

    __slots__ = ("_lifecycle", "_looked", "_rate", "_stopped", "_stride", "_watch", "pid")

    def __init__(self, watch: Watch, pid: int, now: float) -> None:
        self.pid = pid
        self._watch = watch
        self._looked = now
        self._stride = max(_STRIDE * watch.checks.timeout, _LEAST_STRIDE)
        self._stopped = _Lasting()
        self._lifecycle = _Lasting()
        self._rate = _Rate(watch.checks)

    def look(self, seen: Observation, now: float) -> str:
        """Add an observation; return a text on the checks that failed for too long; "": none."""
        gap = now - self._looked
        passed = min(gap, self._stride)
        self._looked = now
        self._stopped.note(seen.stopped, passed)
        allowed = (NoState.NOT_YET, self._watch.checks.lifecycle)
        self._lifecycle.note(seen.state not in allowed, passed)
        if self._watch.topics:
            self._rate.look(seen, now, passed, missed=gap > self._stride)
        reasons = "; ".join(self._reasons(seen))
        return f"unhealthy: {reasons}" if reasons else ""

    def _reasons(self, seen: Observation) -> Iterator[str]:
        wanted = self._watch.checks
        if self._stopped.seconds > wanted.timeout:
            yield f"stopped by a signal (SIGSTOP) for {self._stopped.seconds:.1f} s"
        if self._lifecycle.seconds > wanted.timeout:
            silent = f"no answer from {' or '.join(self._watch.services)}"
            found = silent if seen.state is NoState.NO_ANSWER else f"lifecycle state {seen.state}"
            lasted = self._lifecycle.seconds
            yield f"{found} for {lasted:.1f} s, the state {wanted.lifecycle} is required"
        lasted = self._rate.amiss.seconds
        if lasted > wanted.timeout:
            found = seen.trouble or f"{self._rate.found:.1f} Hz"
            least = f"at least {wanted.rate:g} Hz are required"
            by = " by /clock" if seen.clock is not None else ""
            yield f"{wanted.topic}: {found} for {lasted:.1f} s{by}, {least}"


class _Rate:
    """The rate of messages, counted over a sliding window.

    Attributes:
        amiss: duration for which the rate has been too low.
    """

    __slots__ = (
        "_clock", "_counts", "_idle", "_least", "_messages", "_messages_amiss", "_window", "amiss",
    )  # fmt: skip

    def __init__(self, wanted: Health) -> None:
        self.amiss = _Lasting()
        self._least = wanted.rate
        self._window = _WINDOW * wanted.timeout
        if wanted.rate > 0.0:
            self._window = max(self._window, _PERIODS / wanted.rate)
        self._idle = wanted.timeout  # seconds until the node must publish at its rate
        self._counts: deque[tuple[float, int]] = deque()
        self._messages = 0
        self._messages_amiss = 0
        self._clock: float | None = None

    @property
    def found(self) -> float:
        """Return the rate in Hz while it was too low."""
        return self._messages_amiss / self.amiss.seconds

    def look(self, seen: Observation, now: float, passed: float, *, missed: bool) -> None:
        """Count messages; `missed`: so long since the last observation that some may be lost."""
        before, self._clock = self._clock, seen.clock
        if seen.clock is not None:
            began_anew = before is None or seen.clock < before
            step = 0.0 if before is None else max(0.0, seen.clock - before)
            passed = min(step, passed) if missed else step
            now, missed = seen.clock, missed or began_anew
        elif before is not None:
            missed = True
        if seen.messages is None or missed:
            self._counts.clear()
        self._messages += seen.messages or 0
        amiss = self._is_amiss(seen, now)
        self._idle -= passed
        if amiss is None or self._idle > 0.0:
            return
        was_amiss = self.amiss.amiss
        self.amiss.note(amiss, passed)
        self._messages_amiss = self._messages_amiss + (seen.messages or 0) if was_amiss else 0

    def _is_amiss(self, seen: Observation, now: float) -> bool | None:
        """Return True if the rate is too low; None: not observed for long enough."""
        if seen.messages is None:
            return True
        self._counts.append((now, self._messages))
        while len(self._counts) > 1 and self._counts[1][0] <= now - self._window:
            self._counts.popleft()
        since, before = self._counts[0]
        if now - since < self._window:
            return None
        return self._messages - before + _SLACK < self._least * (now - since)
