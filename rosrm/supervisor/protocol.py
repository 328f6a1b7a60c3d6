"""What travels between the slave (client) and its host's supervisor.

One JSON object a line over the Unix stream socket `supervisor.sock`; several lines may come in one
write. An instance is `[process, number]`. Times are seconds, sizes bytes.

The client orders, by the key `do`:

    hello        protocol, pid, log             first of all; log: the limits of `LogLimits`
    environment  id, variables                  a base that later `start`s name
    start        instance, argv, environment, changes, directory, restart, stop
                                                environment: id of a base; changes: variable to
                                                value, or null to leave it out; restart and stop:
                                                the fields of the policies, in their order
    stop         instance                       SIGINT, SIGTERM, SIGKILL; never heard of: a start
                                                that comes late will be refused
    restart      instance                       stop, then start again
    forget       instances                      their final statuses are kept by the client now
    shutdown                                    stop everything, then end

The supervisor tells, by the key `tell`:

    welcome      protocol, pid, notes, instances   the answer to hello; instances: their statuses
    status       status                            something has changed, or was ordered again
    refused      message                           the connection is closed after it
    ended                                          the shutdown is complete; closed after it

A status is the list of the fields of `Status`, in their order. It is recorded durably before it is
told, and a final one is told at each connection until it is forgotten.
A line that is not understood is refused, never guessed at; so is another protocol number.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from rosrm.core.supervision import (
    Forgotten,
    Instance,
    Key,
    RestartOrdered,
    RestartRule,
    ShutdownOrdered,
    StopOrdered,
    StopRule,
)
from rosrm.supervisor.logs import LogLimits

PROTOCOL: Final = 1
#: Longest line that is read.
LONGEST_LINE: Final = 8 << 20

_encoder: Final = json.JSONEncoder(separators=(",", ":"))


class ProtocolError(Exception):
    """The peer sent what cannot be understood; its text is meant for the peer."""


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


class Forget(NamedTuple):
    """The client has kept these final statuses."""

    instances: tuple[Forgotten, ...]


Order = Hello | Environment | Launch | StopOrdered | RestartOrdered | Forget | ShutdownOrdered


class Status(NamedTuple):
    """The fields of `rosrm.core.model.InstanceStatus`, without its weight."""

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


def _order_fields(order: Order) -> dict[str, Any]:
    if isinstance(order, Hello):
        return {"do": "hello", "protocol": order.protocol, "pid": order.pid, "log": order.log}
    if isinstance(order, Environment):
        return {"do": "environment", "id": order.id, "variables": dict(order.variables)}
    if isinstance(order, Launch):
        return {"do": "start", **launch_fields(order)}
    if isinstance(order, StopOrdered):
        return {"do": "stop", "instance": order.instance}
    if isinstance(order, RestartOrdered):
        return {"do": "restart", "instance": order.instance}
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
    if kind == "start":
        return read_launch(fields)
    if kind == "stop":
        return StopOrdered(read_key(fields["instance"]))
    if kind == "forget":
        return Forget(tuple(Forgotten(read_key(key)) for key in fields["instances"]))
    if kind == "restart":
        return RestartOrdered(read_key(fields["instance"]))
    if kind == "environment":
        return Environment(_text(fields["id"]), _texts(fields["variables"]))
    if kind == "hello":
        return Hello(int(fields["protocol"]), int(fields["pid"]), _limits(fields["log"]))
    if kind == "shutdown":
        return ShutdownOrdered()
    known = "hello, environment, start, stop, restart, forget, shutdown"
    raise ProtocolError(f"unknown order {kind!r}; known: {known}")


def read_launch(fields: Mapping[str, Any]) -> Launch:
    """Undo `launch_fields`. Raises KeyError, TypeError or ValueError."""
    argv = tuple(_text(argument) for argument in fields["argv"])
    directory = fields["directory"]
    changes = fields["changes"]
    if not argv:
        raise ValueError("argv is empty")
    if directory is not None:
        _text(directory)
    for name, value in changes.items():
        _text(name)
        if value is not None:
            _text(value)
    return Launch(
        read_key(fields["instance"]),
        argv,
        _text(fields["environment"]),
        changes,
        directory,
        read_restart(fields["restart"]),
        read_stop(fields["stop"]),
    )


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


def _limits(value: Any) -> LogLimits:
    max_bytes, keep, instances, processes = value
    return LogLimits(int(max_bytes), int(keep), int(instances), int(processes))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def _texts(value: Any) -> dict[str, str]:
    return {_text(name): _text(text) for name, text in value.items()}


# --- what is told -----------------------------------------------------------------------------


def encode_welcome(pid: int, notes: Sequence[str], statuses: Sequence[Status]) -> bytes:
    """The answer to `hello`."""
    welcome = {"tell": "welcome", "protocol": PROTOCOL, "pid": pid, "notes": list(notes)}
    return line({**welcome, "instances": statuses})


def encode_status(status: Status) -> bytes:
    """One line for one change."""
    return line({"tell": "status", "status": status})


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


# --- lines ------------------------------------------------------------------------------------


def line(fields: Mapping[str, Any]) -> bytes:
    """A JSON object in one line."""
    return _encoder.encode(fields).encode() + b"\n"


def parse(text: bytes) -> dict[str, Any]:
    """The JSON object in one line. Raises ProtocolError."""
    try:
        fields = json.loads(text)
    except ValueError as error:
        raise ProtocolError(f"not a line of JSON ({error}): {text[:80]!r}") from None
    if not isinstance(fields, dict):
        raise ProtocolError(f"not a JSON object: {text[:80]!r}")
    return fields


class Lines:
    """Cuts a stream into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes. Raises ProtocolError where one does not end."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            raise ProtocolError(f"a line is longer than {LONGEST_LINE} bytes")
        return lines
