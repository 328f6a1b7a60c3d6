"""Migration strategy `handoff`: both instances run for a moment, and the state is transferred.

The destination starts beside the source under an alias, as in the paper (III-C2). It follows the
source's state without publishing. Then both instances switch over as described in
docs/reference/handoff-protocol.md. A node that meets only the paper's two constraints is migrated
as in the paper (`protocol: paper`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from rosrm import (
    AwaitReleased,
    Capabilities,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Move,
    Plan,
    PositiveSeconds,
    ProcessSpec,
    RestartPolicy,
    SetRestart,
    Start,
    Stop,
    options_of,
)

#: Name of the executor that detects the first publication of a destination (`protocol: paper`).
WATCH: Final = "handoff_watch"
#: Most characters of a node name in ROS 2.
_LONGEST: Final = 255
#: Seconds for the watch to start, in addition to the time for which it listens.
_WATCH_MARGIN: Final = 5.0
_NEVER: Final = RestartPolicy("never")
_TOPIC: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE: Final = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")


@dataclass(frozen=True)
class HandoffOptions:
    """Options of the strategy `handoff`, for all processes or for one.

    Attributes:
        start_timeout: seconds within which the destination must run, and a slave must accept an
            order.
        ready_timeout: seconds within which the destination must have everything that it needs.
        switch_timeout: seconds from the request to switch until the destination is active and the
            source is silent.
        abort_timeout: seconds within which a destination must acknowledge an abort; then it is
            stopped.
        resume_timeout: seconds within which a source must report that it has resumed.
        release_timeout: seconds for which a silent source may wait for the delivery of its last
            outputs, before it is stopped. (A source waits at most 4 s.)
        protocol: "rosrm", or "paper" for a node that meets only the paper's two constraints.
        state: topic of the node's state, with "paper".
        type: message type of that topic, e.g. "std_msgs/msg/Int64".
    """

    start_timeout: PositiveSeconds = 10.0
    ready_timeout: PositiveSeconds = 30.0
    switch_timeout: PositiveSeconds = 10.0
    abort_timeout: PositiveSeconds = 2.0
    resume_timeout: PositiveSeconds = 5.0
    release_timeout: PositiveSeconds = 5.0
    protocol: Literal["rosrm", "paper"] = "rosrm"
    state: str = ""
    type: str = ""

    def __post_init__(self) -> None:
        """Raise `ValueError` if `protocol`, `state` and `type` do not fit together."""
        if self.protocol not in ("rosrm", "paper"):
            raise ValueError(f"protocol {self.protocol!r}; allowed: rosrm, paper")
        if self.protocol == "rosrm":
            if self.state or self.type:
                raise ValueError("state and type go with `protocol: paper`")
        elif not _TOPIC.fullmatch(self.state):
            raise ValueError(
                f"state is {self.state!r}: with `protocol: paper` it names the topic on which the "
                f"node publishes its state in every cycle, as /counter/state"
            )
        elif not _TYPE.fullmatch(self.type):
            raise ValueError(
                f"type is {self.type!r}: with `protocol: paper` it is the type of {self.state}, as "
                f"std_msgs/msg/Int64"
            )


def capabilities(options: HandoffOptions) -> Capabilities:
    """Return what the strategy can do for a process; a node of the paper publishes no snapshots."""
    if options.protocol == "paper":
        return Capabilities()
    return Capabilities(state="topics", shadow=True)


class Handoff:
    """Strategy that plans a stateful migration."""

    def __init__(self, options: HandoffOptions) -> None:
        self._options = options

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Return the reason why `handoff` cannot migrate a process; "" if it can."""
        return _fault(spec, options_of(spec, self._options))

    def propose(self, move: Move) -> Plan:
        """Return the plan: shadow, switch, commit, stop; with "paper": listen, commit, stop."""
        fault = _fault(move.spec, move.options)
        if fault:
            raise ValueError(fault)
        if move.options.protocol == "paper":
            return _as_in_the_paper(move, move.options)
        return _handing_over(move, move.options)


def _fault(spec: ProcessSpec, options: HandoffOptions) -> str:
    if not spec.ros:
        return "it moves only ROS nodes, and this process is none: set `ros: true`"
    if not spec.node:
        return "it starts the node a second time by another name, and `node_name: keep` is set"
    if options.protocol == "paper" and not spec.migration.overlap:
        return "with `protocol: paper` both are active for a moment, and `overlap: false` is set"
    return ""


def _handing_over(move: Move, options: HandoffOptions) -> Plan:
    resume = Configure(HandoffPhase.RESUME, options.resume_timeout)
    abort = Configure(HandoffPhase.ABORT, options.abort_timeout)
    return Plan(
        (
            _start(move, options),
            _suspend(move, options),
            Configure(HandoffPhase.SHADOW, options.ready_timeout, undo=resume),
            Configure(HandoffPhase.SWITCH, options.switch_timeout, undo=abort),
            Commit(),
            _give_restart_policy(move, options),
            AwaitReleased(move.source, move.source_host, options.release_timeout),
            *_end(move, options),
        )
    )


def _as_in_the_paper(move: Move, options: HandoffOptions) -> Plan:
    """Return the paper's plan.

    Both instances are active from the first message of the destination to the end of the source.
    """
    listen = {
        "state": options.state, "type": options.type, "timeout": options.ready_timeout,
        "source": move.source_node, "destination": alias_of(move),
    }  # fmt: skip
    watch_timeout = options.ready_timeout + _WATCH_MARGIN
    return Plan(
        (
            _start(move, options),
            _suspend(move, options),
            Configure(HandoffPhase.SHADOW, options.ready_timeout, awaited=False),
            Execute(WATCH, move.destination_host, listen, watch_timeout),
            Commit(),
            _give_restart_policy(move, options),
            *_end(move, options),
        ),
        overlap=watch_timeout + move.spec.stop.timeout,
    )


def _start(move: Move, options: HandoffOptions) -> Start:
    started = move.destination_spec
    stop = Stop(move.destination, move.destination_host, started.stop.timeout)
    return Start(
        move.destination, move.destination_host, options.start_timeout, alias_of(move), undo=stop,
        shadow=True, remappings=_own_names(started, options),
    )  # fmt: skip


def _own_names(spec: ProcessSpec, options: HandoffOptions) -> dict[str, str]:
    """Return the remapping of a state topic below `~`, which otherwise moves with the alias."""
    namespace = spec.namespace.strip("/")
    own = f"/{namespace}/{spec.node}/" if namespace else f"/{spec.node}/"
    if not options.state.startswith(own):
        return {}
    return {f"~/{options.state[len(own) :]}": options.state}


def _suspend(move: Move, options: HandoffOptions) -> SetRestart:
    """Suspend the source's restarts; a restarted source would be active beside the destination."""
    seconds = options.start_timeout
    give_back = SetRestart(move.source, move.source_host, move.spec.restart, seconds)
    return SetRestart(move.source, move.source_host, _NEVER, seconds, undo=give_back)


def _give_restart_policy(move: Move, options: HandoffOptions) -> SetRestart:
    return SetRestart(
        move.destination, move.destination_host, move.destination_spec.restart,
        options.start_timeout,
    )  # fmt: skip


def _end(move: Move, options: HandoffOptions) -> tuple[Stop, Configure]:
    return (
        Stop(move.source, move.source_host, move.spec.stop.timeout),
        Configure(HandoffPhase.DONE, options.start_timeout),
    )


def alias_of(move: Move) -> str:
    """Return `NAME_<unix time>`, different from the name under which the source runs."""
    name, at = move.destination_spec.node, move.now
    while (alias := _suffixed(name, at)) in (name, move.source_node):
        at += 1
    return alias


def _suffixed(name: str, at: int) -> str:
    suffix = f"_{at}"
    return name[: _LONGEST - len(suffix)] + suffix


def watch(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Wait on the destination's slave until it receives a second publisher of the state."""
    from rosrm.ros.slave.publisher_watch import await_second_publisher  # noqa: PLC0415 - the master has no use

    return await_second_publisher(
        str(arguments["state"]), str(arguments["type"]), str(arguments["source"]),
        str(arguments["destination"]), float(arguments["timeout"]),
    )  # fmt: skip
