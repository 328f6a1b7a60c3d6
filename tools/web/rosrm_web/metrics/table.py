"""Table of all metrics. `docs/reference/metrics.md` has the same table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal


@dataclass(frozen=True)
class Metric:
    """A metric.

    Attributes:
        name: in Prometheus; that of a counter ends with `_total`.
        kind: "gauge": a value of the present; "counter" and "histogram": since the start of the
            process that counts.
        labels: names of its labels.
        meaning: one line for its readers.
    """

    name: str
    kind: Literal["gauge", "counter", "histogram"]
    labels: tuple[str, ...]
    meaning: str


UP: Final = Metric("rosrm_up", "gauge", (), "1: the master answers; 0: it does not")
UPTIME: Final = Metric(
    "rosrm_master_uptime_seconds", "gauge", (), "seconds since the start of the master"
)
ANSWER: Final = Metric(
    "rosrm_master_answer_seconds", "gauge", (),
    "seconds in which the master answered the newest listing, with its transport",
)  # fmt: skip
TURN: Final = Metric(
    "rosrm_master_turn_seconds", "gauge", (), "longest turn of the master's loop within a second"
)
WRITE: Final = Metric(
    "rosrm_journal_write_seconds", "gauge", (), "longest write of the journal within a second"
)
MASTER_CPU: Final = Metric(
    "rosrm_master_cpu_seconds", "gauge", (), "CPU time of the master since its start"
)
OLDEST: Final = Metric(
    "rosrm_oldest_reading_seconds", "gauge", (),
    "age of the oldest among the newest readings of all hosts, at most within a second",
)  # fmt: skip
MISSED: Final = Metric(
    "rosrm_missed_cycles", "gauge", (),
    "cycles of slaves whose messages did not arrive, since the start of the master",
)  # fmt: skip
DECISION: Final = Metric(
    "rosrm_decision_seconds", "gauge", (),
    "longest decision of the master on one event within a second",
)  # fmt: skip
DECISIONS: Final = Metric(
    "rosrm_decisions", "gauge", (), "decisions since the start of the master"
)  # fmt: skip
DECIDING: Final = Metric(
    "rosrm_deciding_seconds", "gauge", (),
    "duration of all decisions since the start of the master",
)  # fmt: skip
DROPPED: Final = Metric(
    "rosrm_dropped_messages", "gauge", (),
    "messages that the master dropped, because their handling failed, since its start",
)  # fmt: skip
STRANGERS: Final = Metric(
    "rosrm_stranger_messages", "gauge", (),
    "messages to the master and its slaves without a valid key, since the start of the master",
)  # fmt: skip
TROUBLE: Final = Metric(
    "rosrm_master_trouble", "gauge", (),
    "1: the master accepts no new work, for example in a journal stall",
)  # fmt: skip
SEQUENCE: Final = Metric("rosrm_journal_sequence", "gauge", (), "sequence of the newest event")
HOSTS: Final = Metric("rosrm_hosts", "gauge", ("state",), "hosts in each state")
HOST_UP: Final = Metric("rosrm_host_up", "gauge", ("host",), "1: the state of the host is up")
HOST_CORDONED: Final = Metric(
    "rosrm_host_cordoned", "gauge", ("host",), "1: the host is cordoned or draining"
)
HOST_AGE: Final = Metric(
    "rosrm_host_reading_age_seconds", "gauge", ("host",), "age of the newest reading of the host"
)
HOST_PROCESSES: Final = Metric(
    "rosrm_host_processes", "gauge", ("host",), "processes on the host"
)  # fmt: skip
USAGE: Final = Metric(
    "rosrm_resource_usage_ratio", "gauge", ("host", "resource"),
    "usage, as a fraction of the capacity; absent while the reading is stale",
)  # fmt: skip
IN_FLIGHT: Final = Metric(
    "rosrm_resource_in_flight_ratio", "gauge", ("host", "resource"),
    "reserved for processes that start, as a fraction of the capacity",
)  # fmt: skip
LIMIT: Final = Metric(
    "rosrm_resource_limit_ratio", "gauge", ("host", "resource"),
    "limit, as a fraction of the capacity",
)  # fmt: skip
CAPACITY: Final = Metric(
    "rosrm_resource_capacity", "gauge", ("host", "resource"), "capacity, in the resource's unit"
)
PROCESSES: Final = Metric("rosrm_processes", "gauge", ("state",), "processes in each state")
QUEUE: Final = Metric("rosrm_queue_length", "gauge", (), "processes in the queue")
QUEUE_AGE: Final = Metric(
    "rosrm_queue_oldest_seconds", "gauge", (),
    "time for which the oldest process in the queue has waited",
)  # fmt: skip
CPU: Final = Metric(
    "rosrm_process_cpu_cores", "gauge", ("process", "host"), "CPU usage of a process, in cores"
)
MEMORY: Final = Metric(
    "rosrm_process_memory_bytes", "gauge", ("process", "host"), "memory usage of a process"
)
RESTARTS: Final = Metric(
    "rosrm_process_restarts", "gauge", ("process", "host"), "restarts of the present instance"
)
LEFT_OUT: Final = Metric(
    "rosrm_processes_left_out", "gauge", (),
    "processes without metrics of their own, because there are too many",
)  # fmt: skip
APPLICATIONS: Final = Metric(
    "rosrm_applications", "gauge", ("state",), "applications in each state"
)  # fmt: skip
PLUGINS: Final = Metric("rosrm_plugins_failing", "gauge", (), "plugins that fail")
EVENTS: Final = Metric("rosrm_events_total", "counter", ("kind",), "events of each kind")
MIGRATIONS: Final = Metric(
    "rosrm_migrations_total", "counter", ("strategy", "outcome"),
    "ended migrations; outcome: moved (or replaced by a new version), stayed",
)  # fmt: skip
MIGRATION_TIME: Final = Metric(
    "rosrm_migration_seconds", "histogram", ("strategy",),
    "duration of migrations that moved a process",
)  # fmt: skip
BLACKOUT: Final = Metric(
    "rosrm_migration_blackout_seconds", "histogram", ("strategy",),
    "time in a migration in which neither source nor destination was active",
)  # fmt: skip
WAIT: Final = Metric(
    "rosrm_queue_wait_seconds", "histogram", (), "time from the queue to the choice of a host"
)
START: Final = Metric(
    "rosrm_start_seconds", "histogram", (), "time from the choice of a host until a process runs"
)
TOKENS: Final = Metric(
    "rosrm_web_tokens_invalid", "gauge", (),
    "1: the changed file of tokens is invalid, and the former tokens stay valid; `rosrm web` only",
)  # fmt: skip

#: Metrics of the present, and metrics that events count.
PRESENT: Final = (
    UP, UPTIME, ANSWER, TURN, WRITE, MASTER_CPU, OLDEST, MISSED, DECISION, DECISIONS,
    DECIDING, DROPPED, STRANGERS, TROUBLE, SEQUENCE,
    HOSTS, HOST_UP, HOST_CORDONED, HOST_AGE, HOST_PROCESSES, USAGE, IN_FLIGHT, LIMIT, CAPACITY,
    PROCESSES, QUEUE, QUEUE_AGE, CPU, MEMORY, RESTARTS, LEFT_OUT, APPLICATIONS, PLUGINS, TOKENS,
)  # fmt: skip
COUNTED: Final = (EVENTS, MIGRATIONS, MIGRATION_TIME, BLACKOUT, WAIT, START)
