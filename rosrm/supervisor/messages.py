"""What travels between the slave (client) and its host's supervisor.

One JSON object a line over the Unix stream socket `supervisor.sock`; several lines may come in one
write. An instance is `[process, number]`. Times are seconds, sizes bytes.

The client orders, by the key `do`:

    hello        protocol, pid, log             first of all; log: the limits of `LogLimits`
    environment  id, variables                  a base that later `start`s name
    start        instance, argv, environment, changes, directory, restart, stop, fence,
                 heard, memo
                                                environment: id of a base; changes: variable to
                                                value, or null to leave it out; restart and stop:
                                                the fields of the policies, in their order
                                                fence: null, or [after, grace, alive]: see
                                                `heard`, of which the start has one as well; 0: now
                                                memo: a text that is kept for the client
    stop         instance                       SIGINT, SIGTERM, SIGKILL; never heard of: a start
                                                that comes late will be refused
    fence        instance                       SIGKILL to all of it; never heard of: as with stop
    heard        at, alive                      the master is known to have heard this host at one
                                                time (by CLOCK_MONOTONIC), the client was at work at
                                                the other; `after` seconds after the newest that
                                                counts (a fence that is `alive` counts both) what
                                                has a fence ends, by SIGKILL `grace` later
    restart      instance                       stop, then start again
    fail         instance, pid, reason, kill    this run of it counts as failed: stop it, at once by
                                                SIGKILL where kill is true; then its restart policy
    amend        instance, restart, changes     from now on it has this restart policy, and these
                                                changes on top of its own when it starts again
    remember     instance, memo                 another text to keep
    forget       instances                      their final statuses are kept by the client now
    shutdown                                    stop everything, then end

The supervisor tells, by the key `tell`:

    welcome      protocol, pid, notes, instances, memos, fenced
                                                   the answer to hello; instances: their statuses;
                                                   memos: [instance, text] of those that have one
                                                   fenced: those that have a fence
    status       status                            something has changed, or was ordered again
    amended      instance, restart                 the order is recorded; its status came before
    refused      message                           the connection is closed after it
    ended                                          the shutdown is complete; closed after it

A status is the list of the fields of `Status`, in their order. It is recorded durably before it is
told, and a final one is told at each connection until it is forgotten.
A line that is not understood is refused, never guessed at; so is another protocol number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from rosrm.core.supervisor.reducer import (
    AmendOrdered,
    FailOrdered,
    FenceOrdered,
    FenceRule,
    Forgotten,
    Heard,
    Instance,
    Key,
    RestartOrdered,
    RestartRule,
    ShutdownOrdered,
    StopOrdered,
    StopRule,
)
from rosrm.supervisor.json_lines import ProtocolError, line, parse
from rosrm.supervisor.logs import LogLimits

PROTOCOL: Final = 3


class Hello(NamedTuple):
    """The client introduces itself."""

    protocol: int
    pid: int
    log: LogLimits


class Environment(NamedTuple):
    """A base environment, under the name by which `Launch` refers to it."""

    id: str
    variables: Mapping[str, str]


class Launch(NamedTuple):
    """Everything that is needed to start an instance, again and again."""

    instance: Key
    argv: tuple[str, ...]
    environment: str
    changes: Mapping[str, str | None]
    directory: str | None
    restart: RestartRule
    stop: StopRule
    memo: str = ""
    fence: FenceRule | None = None
    heard: float = 0.0

    def amended(self, amendment: Amend) -> Launch:
        """How it is started after an amendment."""
        changes = {**self.changes, **amendment.changes}
        return self._replace(changes=changes, restart=amendment.order.restart)


class Amend(NamedTuple):
    """Another restart policy, and another environment when it starts again."""

    order: AmendOrdered
    changes: Mapping[str, str | None]


class Remember(NamedTuple):
    """What the client wants to know of an instance after its own restart."""

    instance: Key
    memo: str


class Forget(NamedTuple):
    """The client has kept these final statuses."""

    instances: tuple[Forgotten, ...]


Order = (
    Hello
    | Environment
    | Launch
    | StopOrdered
    | FenceOrdered
    | Heard
    | RestartOrdered
    | FailOrdered
    | Amend
    | Remember
    | Forget
    | ShutdownOrdered
)


class Status(NamedTuple):
    """The fields of `rosrm.model.values.InstanceStatus`, without its weight."""

    instance: Key
    state: str
    pid: int
    exit_code: int
    exit_signal: int
    restarts: int
    peak_memory: float
    cpu_time: float
    run_time: float
    message: str

    @classmethod
    def of(cls, instance: Instance) -> Status:
        """What is told of an instance."""
        return cls(
            instance.key,
            instance.phase,
            instance.pid,
            instance.exit_code,
            instance.exit_signal,
            instance.restarts,
            instance.peak_memory,
            instance.cpu_time,
            instance.run_time,
            instance.message,
        )


# --- orders -----------------------------------------------------------------------------------


def encode_order(order: Order) -> bytes:
    """One line."""
    return line(_order_fields(order))


_WORDS: Final[Mapping[type, str]] = {
    StopOrdered: "stop",
    FenceOrdered: "fence",
    Heard: "heard",
    RestartOrdered: "restart",
    FailOrdered: "fail",
}


def _order_fields(order: Order) -> dict[str, Any]:
    if isinstance(order, Hello):
        return {"do": "hello", "protocol": order.protocol, "pid": order.pid, "log": order.log}
    if isinstance(order, Environment):
        return {"do": "environment", "id": order.id, "variables": dict(order.variables)}
    if isinstance(order, Launch):
        return {"do": "start", **launch_fields(order)}
    if isinstance(order, (StopOrdered, FenceOrdered, Heard, RestartOrdered, FailOrdered)):
        return {"do": _WORDS[type(order)], **order._asdict()}
    if isinstance(order, Amend):
        instance, restart = order.order
        changes = dict(order.changes)
        return {"do": "amend", "instance": instance, "restart": restart, "changes": changes}
    if isinstance(order, Remember):
        return {"do": "remember", "instance": order.instance, "memo": order.memo}
    if isinstance(order, Forget):
        return {"do": "forget", "instances": [forgotten.instance for forgotten in order.instances]}
    return {"do": "shutdown"}


def launch_fields(launch: Launch) -> dict[str, Any]:
    """A launch as JSON can hold it; the record keeps it so too."""
    return {
        "instance": launch.instance,
        "argv": launch.argv,
        "environment": launch.environment,
        "changes": dict(launch.changes),
        "directory": launch.directory,
        "restart": launch.restart,
        "stop": launch.stop,
        "fence": launch.fence,
        "heard": launch.heard,
        "memo": launch.memo,
    }


def decode_order(text: bytes) -> Order:
    """The order in one line. Raises ProtocolError."""
    fields = parse(text)
    kind = fields.get("do")
    try:
        return _order(kind, fields)
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"the order {kind!r} cannot be read: {error!r}") from None


def _order(kind: object, fields: Mapping[str, Any]) -> Order:
    reader = _READERS.get(kind) if isinstance(kind, str) else None
    if reader is None:
        raise ProtocolError(f"unknown order {kind!r}; known: {', '.join(_READERS)}")
    return reader(fields)


def read_launch(fields: Mapping[str, Any]) -> Launch:
    """Undo `launch_fields`. Raises KeyError, TypeError or ValueError."""
    argv = tuple(_text(argument) for argument in fields["argv"])
    directory = fields["directory"]
    if not argv:
        raise ValueError("argv is empty")
    if directory is not None:
        _text(directory)
    return Launch(
        read_key(fields["instance"]),
        argv,
        _text(fields["environment"]),
        _changes(fields["changes"]),
        directory,
        read_restart(fields["restart"]),
        read_stop(fields["stop"]),
        _text(fields.get("memo", "")),  # records of before protocol 2 have none
        read_fence(fields.get("fence")),  # and before protocol 3 none of these
        float(fields.get("heard", 0.0)),
    )


def _read_fail(fields: Mapping[str, Any]) -> FailOrdered:
    key, pid = read_key(fields["instance"]), int(fields["pid"])
    return FailOrdered(key, pid, _text(fields["reason"]), bool(fields["kill"]))


def _read_amend(fields: Mapping[str, Any]) -> Amend:
    order = AmendOrdered(read_key(fields["instance"]), read_restart(fields["restart"]))
    return Amend(order, _changes(fields["changes"]))


_READERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Order]]] = {
    "hello": lambda fields: Hello(
        int(fields["protocol"]), int(fields["pid"]), _limits(fields["log"])
    ),
    "environment": lambda fields: Environment(_text(fields["id"]), _texts(fields["variables"])),
    "start": read_launch,
    "stop": lambda fields: StopOrdered(read_key(fields["instance"])),
    "fence": lambda fields: FenceOrdered(read_key(fields["instance"])),
    "heard": lambda fields: Heard(float(fields["at"]), float(fields["alive"])),
    "restart": lambda fields: RestartOrdered(read_key(fields["instance"])),
    "fail": _read_fail,
    "amend": _read_amend,
    "remember": lambda fields: Remember(read_key(fields["instance"]), _text(fields["memo"])),
    "forget": lambda fields: Forget(tuple(Forgotten(read_key(key)) for key in fields["instances"])),
    "shutdown": lambda _: ShutdownOrdered(),
}


def read_key(value: Any) -> Key:
    """An instance from its JSON list."""
    process, number = value
    return _text(process), int(number)


def read_restart(value: Sequence[Any]) -> RestartRule:
    """A restart policy from its JSON list."""
    when, delay, max_delay, factor, attempts, window = value
    if when not in ("never", "on-failure", "always"):
        raise ValueError(f"restart when {when!r}")
    return RestartRule(
        when, float(delay), float(max_delay), float(factor), int(attempts), float(window)
    )


def read_stop(value: Sequence[Any]) -> StopRule:
    """A stop policy from its JSON list."""
    interrupt_grace, terminate_grace = value
    return StopRule(float(interrupt_grace), float(terminate_grace))


def read_fence(value: Sequence[Any] | None) -> FenceRule | None:
    """A fence from its JSON list."""
    if value is None:
        return None
    after, grace, alive = value
    return FenceRule(float(after), float(grace), bool(alive))


def _limits(value: Any) -> LogLimits:
    max_bytes, keep, instances, processes = value
    return LogLimits(int(max_bytes), int(keep), int(instances), int(processes))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def _changes(value: Any) -> dict[str, str | None]:
    return {
        _text(name): None if change is None else _text(change) for name, change in value.items()
    }


def _texts(value: Any) -> dict[str, str]:
    return {_text(name): _text(text) for name, text in value.items()}


# --- what is told -----------------------------------------------------------------------------


def encode_welcome(
    pid: int,
    notes: Sequence[str],
    statuses: Sequence[Status],
    memos: Mapping[Key, str],
    fenced: Sequence[Key],
) -> bytes:
    """The answer to `hello`."""
    welcome = {"tell": "welcome", "protocol": PROTOCOL, "pid": pid, "notes": list(notes)}
    known = {"instances": statuses, "memos": list(memos.items()), "fenced": fenced}
    return line({**welcome, **known})


def encode_status(status: Status) -> bytes:
    """One line for one change."""
    return line({"tell": "status", "status": status})


def encode_amended(order: AmendOrdered) -> bytes:
    """It is in the record."""
    return line({"tell": "amended", "instance": order.instance, "restart": order.restart})


def encode_refusal(message: str) -> bytes:
    """The last line of a connection that is turned down."""
    return line({"tell": "refused", "message": message})


def encode_ended() -> bytes:
    """The last line of all."""
    return line({"tell": "ended"})


def read_status(value: Sequence[Any]) -> Status:
    """A status from its JSON list."""
    status = Status(*value)
    return status._replace(instance=read_key(status.instance))
