"""Protocol between the slave (client) and its host's supervisor.

One JSON object per line over the Unix stream socket `supervisor.sock`; one write may carry several
lines. An instance is `[process, number]`. Times are seconds, sizes bytes.

The client sends orders; the key `do` names the order:

    hello        protocol, pid, log,            the first order; log: the first four limits of
                 log_bytes                      `LogLimits`; log_bytes: the last one
    environment  id, variables                  a base environment that later `start`s refer to
    start        instance, argv, environment, changes, directory, restart, stop, fence,
                 heard, memo, limits,
                 secrets, adoption, slots,
                 files, contents
                                                environment: id of a base; changes: variable to
                                                value, or null to leave it out; restart and stop:
                                                the fields of the policies, in their order
                                                fence: null, or [after, grace, alive]: see
                                                `heard`; heard: last contact; 0: now
                                                memo: a text that is kept for the client
                                                limits: the fields of `LimitRule`, in their order
                                                secrets: variable to the path of a file, whose
                                                content is read at each start and never recorded
                                                adoption: null, or [pid, birth, boot] of a process
                                                that runs and becomes the first run
                                                slots: start once fewer than this number of others
                                                are neither held nor ended; 0: start at once
                                                files: words of argv that should name files in
                                                the directory
                                                contents: path to the content of a file that the
                                                instance reads, which is written before each start
    stop         instance                       SIGINT, SIGTERM, SIGKILL; for an unknown instance:
                                                refuse a `start` that arrives later
    fence        instance                       SIGKILL to the process tree; for an unknown
                                                instance: as with stop
    heard        at, alive                      last contact: the master received a message of this
                                                host at `at`, the client worked at `alive`
                                                (CLOCK_BOOTTIME). An instance with a fence is
                                                ended `after` seconds after the newest `at` (with
                                                `alive` in the fence: after the newest of both),
                                                by SIGKILL `grace` seconds later
    restart      instance, run                  stop, then start again; run: [pid, restarts] of the
                                                run that is to end, or null for any run
    fail         instance, pid, reason, kill    count this run as failed: stop it (kill: at once by
                                                SIGKILL), then apply the restart policy
    amend        instance, restart, changes,    replace the restart policy, and apply these changes
                 limits                         on top of the earlier ones at the next start
                                                limits: null, or the new ones, as the fields of
                                                `RunLimits`, which hold from now on
    remember     instance, memo                 replace the memo
    forget       instances                      the client has stored their final statuses
    shutdown                                    stop everything, then end

The supervisor sends messages; the key `tell` names the message:

    welcome      protocol, pid, notes, instances, memos, fenced, unenforced, groups, secrets,
                 amends, adopts, holds, contents
                                                   the answer to hello; instances: their statuses;
                                                   memos: [instance, text] of those that have one
                                                   fenced: those that have a fence
                                                   unenforced: limit or scheduling setting to the
                                                   reason why it cannot be enforced
                                                   groups: [version, directory, controllers] where
                                                   the control groups of instances are
                                                   secrets: true, for it reads them at each start
                                                   amends: true: it can change limits
                                                   adopts: true: it can adopt processes
                                                   holds: true: it can hold a start (`slots`)
                                                   contents: true: it writes the files of instances
    status       status                            a change, or the answer to a repeated order; not
                                                   "starting" if the spawn follows at once
    amended      instance, restart, limits,        the amendment is recorded; its status came before
                 refusal                           refusal: "", or why nothing has changed
    refused      message                           the supervisor closes the connection after it
    ended                                          the shutdown is complete; closed after it

A status is the list of the fields of `Status`, in their order. The supervisor records a status
durably before it sends it, and sends a final status at each connection until a `forget`.
The supervisor refuses a line that it cannot decode, and another protocol number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from rosrm.core.supervisor import events
from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.rules import (
    AdoptionRule,
    FenceRule,
    Key,
    LimitRule,
    RestartRule,
    RunLimits,
    StopRule,
)
from rosrm.model.durations import LONGEST, LONGEST_STOP
from rosrm.supervisor.json_lines import ProtocolError, line, parse
from rosrm.supervisor.logs import LogLimits

PROTOCOL: Final = 3
#: What a reader of JSON raises for values of another shape.
UNREADABLE: Final = (KeyError, TypeError, ValueError, AttributeError, OverflowError)

#: Largest number in a message: that of an instance is an unsigned integer of 64 bits.
_MOST_NUMBER: Final = 2**64 - 1
#: Largest id of a process.
_LARGEST_PID: Final = 2**31 - 1
#: Largest number of a CPU.
_MOST_CPU: Final = 65_535
#: Largest time or amount in a message, so that sums stay finite.
_MOST_TIME: Final = 1e300


class Hello(NamedTuple):
    """The first message of a client."""

    protocol: int
    pid: int
    log: LogLimits


class Environment(NamedTuple):
    """A base environment with the id by which `Launch` refers to it."""

    id: str
    variables: Mapping[str, str]


class Launch(NamedTuple):
    """Everything needed to start an instance any number of times."""

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
    limits: LimitRule = LimitRule()
    secrets: Mapping[str, str] = MappingProxyType({})
    adoption: AdoptionRule | None = None
    slots: int = 0
    files: tuple[str, ...] = ()
    contents: Mapping[str, str] = MappingProxyType({})

    def amended(self, amendment: Amend) -> Launch:
        """Return this launch as it is after an amendment."""
        changes = {**self.changes, **amendment.changes}
        limits = self.limits.with_limits(amendment.limits)
        return self._replace(changes=changes, restart=amendment.restart, limits=limits)


class Amend(NamedTuple):
    """A new restart policy, environment changes for the next start, and new limits.

    Attributes:
        limits: None: they stay.
    """

    instance: Key
    restart: RestartRule
    changes: Mapping[str, str | None]
    limits: RunLimits | None = None


class Remember(NamedTuple):
    """A text about an instance that the client reads back after its own restart."""

    instance: Key
    memo: str


class Forget(NamedTuple):
    """The client has stored these final statuses."""

    instances: tuple[events.StatusStored, ...]


Order = (
    Hello
    | Environment
    | Launch
    | events.StopOrdered
    | events.FenceOrdered
    | events.ContactReported
    | events.RestartOrdered
    | events.FailOrdered
    | Amend
    | Remember
    | Forget
    | events.ShutdownOrdered
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
    enforced: tuple[str, ...] = ()

    @classmethod
    def of(cls, instance: Instance, now: float) -> Status:
        """Return the status that is sent for an instance."""
        fields = [getattr(instance, name) for name in cls._fields[2:]]
        status = cls(instance.key, instance.phase, *fields)
        return status._replace(run_time=instance.time_run(now))


# --- orders -----------------------------------------------------------------------------------


def encode_order(order: Order) -> bytes:
    """Return an order as one line."""
    fields = order._asdict()
    if isinstance(order, Hello):
        fields["log"], fields["log_bytes"] = order.log[:4], order.log.keep_bytes
    elif isinstance(order, Environment):
        fields["variables"] = dict(order.variables)
    elif isinstance(order, Launch):
        fields = launch_fields(order)
    elif isinstance(order, Amend):
        fields["changes"] = dict(order.changes)
    elif isinstance(order, Forget):
        fields = {"instances": [forgotten.instance for forgotten in order.instances]}
    return line({"do": _KINDS[type(order)], **fields})


_KINDS: Final[Mapping[type, str]] = {
    Hello: "hello",
    Environment: "environment",
    Launch: "start",
    events.StopOrdered: "stop",
    events.FenceOrdered: "fence",
    events.ContactReported: "heard",
    events.RestartOrdered: "restart",
    events.FailOrdered: "fail",
    Amend: "amend",
    Remember: "remember",
    Forget: "forget",
    events.ShutdownOrdered: "shutdown",
}


def launch_fields(launch: Launch) -> dict[str, Any]:
    """Return a launch in values that JSON can hold; the record stores the same form."""
    mappings = ("changes", "secrets", "contents")
    return {**launch._asdict(), **{name: dict(getattr(launch, name)) for name in mappings}}


def decode_order(text: bytes) -> Order:
    """Return the order in one line. Raises ProtocolError."""
    fields = parse(text)
    kind = fields.get("do")
    reader = _READERS.get(kind) if isinstance(kind, str) else None
    if reader is None:
        raise ProtocolError(f"unknown order {kind!r}; known: {', '.join(_READERS)}")
    try:
        return reader(fields)
    except UNREADABLE as error:
        raise ProtocolError(f"the order {kind!r} cannot be read: {error!r}") from None


def read_launch(fields: Mapping[str, Any]) -> Launch:
    """Undo `launch_fields`. Raises one of `UNREADABLE`."""
    argv = tuple(read_text(argument) for argument in fields["argv"])
    directory = fields["directory"]
    if not argv:
        raise ValueError("argv is empty")
    if directory is not None:
        read_text(directory)
    return Launch(
        read_key(fields["instance"]),
        argv,
        read_text(fields["environment"]),
        _changes(fields["changes"]),
        directory,
        read_restart(fields["restart"]),
        read_stop(fields["stop"]),
        read_text(fields.get("memo", "")),  # records from before protocol 2 have no memo
        read_fence(fields.get("fence")),  # before protocol 3 neither of these
        read_time(fields.get("heard", 0.0)),
        read_limits(fields.get("limits", ())),
        read_texts(fields.get("secrets", {})),
        _adoption(fields.get("adoption")),
        read_whole(fields.get("slots", 0), 0),  # not sent by clients of an earlier version
        tuple(read_text(word) for word in fields.get("files", ())),  # nor these
        read_texts(fields.get("contents", {})),  # nor these
    )


def _run(value: Sequence[Any] | None) -> tuple[int, int] | None:
    if value is None:  # not sent by clients of an earlier version
        return None
    pid, restarts = value
    return read_whole(pid, 0), read_whole(restarts, 0)


def _read_fail(fields: Mapping[str, Any]) -> events.FailOrdered:
    key, pid = read_key(fields["instance"]), read_whole(fields["pid"])
    return events.FailOrdered(key, pid, read_text(fields["reason"]), bool(fields["kill"]))


def _read_amend(fields: Mapping[str, Any]) -> Amend:
    return Amend(
        read_key(fields["instance"]), read_restart(fields["restart"]), _changes(fields["changes"]),
        read_run_limits(fields.get("limits")),  # not sent by clients of an earlier version
    )  # fmt: skip


_READERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Order]]] = {
    "hello": lambda fields: Hello(
        read_whole(fields["protocol"]), read_whole(fields["pid"]), _limits(fields)
    ),
    "environment": lambda fields: Environment(
        read_text(fields["id"]), read_texts(fields["variables"])
    ),
    "start": read_launch,
    "stop": lambda fields: events.StopOrdered(read_key(fields["instance"])),
    "fence": lambda fields: events.FenceOrdered(read_key(fields["instance"])),
    "heard": lambda fields: events.ContactReported(
        read_amount(fields["at"]), read_amount(fields["alive"])
    ),
    "restart": lambda fields: events.RestartOrdered(
        read_key(fields["instance"]), _run(fields.get("run"))
    ),
    "fail": _read_fail,
    "amend": _read_amend,
    "remember": lambda fields: Remember(read_key(fields["instance"]), read_text(fields["memo"])),
    "forget": lambda fields: Forget(
        tuple(events.StatusStored(read_key(key)) for key in fields["instances"])
    ),
    "shutdown": lambda _: events.ShutdownOrdered(),
}


def read_key(value: Any) -> Key:
    """Return an instance from its JSON list."""
    process, number = value
    read_text(process).encode("utf-8", "surrogateescape")  # it becomes part of a file's name
    return process, read_whole(number, -1, _MOST_NUMBER)


def read_restart(value: Sequence[Any]) -> RestartRule:
    """Return a restart policy from its JSON list."""
    when, delay, max_delay, factor, attempts, window = value
    if when not in ("never", "on-failure", "always"):
        raise ValueError(f"restart when {when!r}")
    return RestartRule(
        when, _wait(delay), _wait(max_delay), read_amount(factor), read_whole(attempts, 0),
        _wait(window),
    )  # fmt: skip


def read_stop(value: Sequence[Any]) -> StopRule:
    """Return a stop policy from its JSON list."""
    interrupt_grace, terminate_grace = (min(_wait(one), LONGEST_STOP) for one in value)
    return StopRule(interrupt_grace, min(terminate_grace, LONGEST_STOP - interrupt_grace))


def read_fence(value: Sequence[Any] | None) -> FenceRule | None:
    """Return a fence from its JSON list."""
    if value is None:
        return None
    after, grace, alive = value
    return FenceRule(_wait(after), _wait(grace), bool(alive))


def read_limits(value: Sequence[Any]) -> LimitRule:
    """Return limits from their JSON list, which may have fewer fields."""
    rule = LimitRule(*value)
    cpus = tuple(read_whole(number, 0, _MOST_CPU) for number in rule.cpus)
    if rule.policy not in ("", "fifo", "rr"):
        raise ValueError(f"real-time policy {rule.policy!r}")
    return LimitRule(
        read_amount(rule.memory), read_amount(rule.memory_high), read_amount(rule.cpu), cpus,
        rule.policy, read_whole(rule.priority, 0, 99), read_whole(rule.nice, -20, 19),
        bool(rule.required),
    )  # fmt: skip


def read_run_limits(value: Sequence[Any] | None) -> RunLimits | None:
    """Return limits that can be changed from their JSON list."""
    if value is None:
        return None
    memory, memory_high, cpu, required = value
    return RunLimits(
        read_amount(memory), read_amount(memory_high), read_amount(cpu), bool(required)
    )


def read_text(value: Any) -> str:
    """Return a JSON value that must be a text. Raises TypeError."""
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def read_texts(value: Any) -> dict[str, str]:
    """Return a JSON object that must hold texts alone. Raises AttributeError or TypeError."""
    return {read_text(name): read_text(text) for name, text in value.items()}


def read_whole(value: Any, low: int = -_MOST_NUMBER, high: int = _MOST_NUMBER) -> int:
    """Return a JSON value that must be a whole number in a range. Raises TypeError, ValueError."""
    if type(value) is not int:
        raise TypeError(f"{value!r} is not a whole number")
    if not low <= value <= high:
        raise ValueError(f"{value} is not within {low}..{high}")
    return value


def read_time(value: Any) -> float:
    """Return a JSON value that must be a finite number. Raises TypeError or ValueError."""
    if type(value) not in (int, float):
        raise TypeError(f"{value!r} is not a number")
    if not -_MOST_TIME <= value <= _MOST_TIME:  # never true for NaN
        raise ValueError(f"{value} is not a time or an amount")
    return float(value)


def read_amount(value: Any) -> float:
    """Return a JSON value that must be a finite number from 0. Raises TypeError or ValueError."""
    amount = read_time(value)
    if amount < 0.0:
        raise ValueError(f"{value} is negative")
    return amount


def _wait(value: Any) -> float:
    """Return a delay or grace in seconds; records of earlier releases may hold longer ones."""
    return min(read_amount(value), LONGEST)


def _adoption(value: Sequence[Any] | None) -> AdoptionRule | None:
    if value is None:
        return None
    pid, birth, boot = value
    return AdoptionRule(read_whole(pid, 1, _LARGEST_PID), read_whole(birth, 0), read_text(boot))


def _limits(fields: Mapping[str, Any]) -> LogLimits:
    max_bytes, keep, instances, processes = map(read_whole, fields["log"])
    keep_bytes = read_whole(
        fields.get("log_bytes", LogLimits().keep_bytes)
    )  # older slaves do not send it
    return LogLimits.bounded(max_bytes, keep, instances, processes, keep_bytes)


def _changes(value: Any) -> dict[str, str | None]:
    return {
        read_text(name): None if change is None else read_text(change)
        for name, change in value.items()
    }


# --- messages of the supervisor ---------------------------------------------------------------


def encode_welcome(
    pid: int, notes: Sequence[str], statuses: Sequence[Status], memos: Mapping[Key, str],
    fenced: Sequence[Key], *, unenforced: Mapping[str, str], groups: Sequence[Sequence[Any]],
) -> bytes:  # fmt: skip
    """Return the answer to `hello`."""
    welcome = {"tell": "welcome", "protocol": PROTOCOL, "pid": pid, "notes": list(notes)}
    known = {"instances": statuses, "memos": list(memos.items()), "fenced": fenced}
    return line({**welcome, **known, "unenforced": dict(unenforced), "groups": groups,
                 "secrets": True, "amends": True, "adopts": True, "holds": True,
                 "contents": True})  # fmt: skip


def encode_status(status: Status) -> bytes:
    """Return the line for one changed status."""
    return line({"tell": "status", "status": status})


def encode_amended(order: Amend, refusal: str) -> bytes:
    """Return the line that confirms a recorded amendment, or refuses it."""
    what = {"instance": order.instance, "restart": order.restart, "limits": order.limits}
    return line({"tell": "amended", **what, "refusal": refusal})


def encode_refusal(message: str) -> bytes:
    """Return the last line of a refused connection."""
    return line({"tell": "refused", "message": message})


def encode_ended() -> bytes:
    """Return the last line after a complete shutdown."""
    return line({"tell": "ended"})


def read_status(value: Sequence[Any]) -> Status:
    """Return a status from its JSON list."""
    status = Status(*value)
    enforced = tuple(read_text(name) for name in status.enforced)
    return status._replace(instance=read_key(status.instance), enforced=enforced)
