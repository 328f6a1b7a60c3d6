"""Kinds of events in the event record, with their meanings.

`python scripts/event_table.py` copies the table to `docs/reference/events.md`.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Self


class EventKind(str, Enum):
    """Kind of an event.

    Attributes:
        meaning: one line for the reference page.
    """

    meaning: str

    def __new__(cls, text: str, meaning: str = "") -> Self:
        """Create a member from its name in the journal and its meaning."""
        kind = str.__new__(cls, text)
        kind._value_ = text
        kind.meaning = meaning
        return kind

    # --- master and journal --------------------------------------------------------------

    MASTER_STARTED = "master_started", "the master started, with its epoch"
    MASTER_STOPPED = "master_stopped", "the master stopped, with the cause"
    JOURNAL_RECOVERED = "journal_recovered", "a damaged journal was rebuilt: `master --recover`"
    JOURNAL_BACK = "journal_back", "the journal can be written again after a journal stall"
    JOURNAL_BEHIND = "journal_behind", "the newest records of the journal are missing"
    PEER_REFUSED = "peer_refused", "a message was refused: another protocol version, or malformed"
    PRUNED = "pruned", "ended processes were removed from the listings"
    SETTINGS_RELOADED = "settings_reloaded", "the settings of a file apply without a restart"
    RELOAD_REFUSED = "reload_refused", "a file with settings is not valid, and changes nothing"

    # --- processes -----------------------------------------------------------------------

    SUBMITTED = "submitted", "a client submitted the process"
    ASSIGNED = (
        "assigned",
        "a host was chosen; facts: the decision, the newest snapshot",
    )
    WAITS = "waits", "the head of the queue waits; facts: the decision"
    QUEUED = "queued", "the process returns to the queue, with the cause"
    SET_ASIDE = "set_aside", "no known host may ever take the process, with the reason"
    STARTING = "starting", "the process was started and is not ready yet"
    RUNNING = "running", "the process runs, and has no node that shows when it is ready"
    READY = "ready", "the node of the process is in the ROS graph"
    REACHABLE = "reachable", "the host of the process reports again, and the process still runs"
    BACKOFF = "backoff", "the process ended and is started again after a delay"
    STOPPING = "stopping", "the process is being stopped"
    FINISHED = "finished", "the process ended with success"
    FAILED = "failed", "the process ended and is not started again"
    CANCEL_REQUESTED = (
        "cancel_requested",
        "a client cancels the process, or its group ends; facts: group, ended",
    )
    CANCELLED = "cancelled", "the process ended because it was cancelled"
    OVERDUE = "overdue", "the time limit of the job has passed: it is stopped, and has failed"
    RESTART_REQUESTED = "restart_requested", "a client restarts the process"
    RESTART_REFUSED = "restart_refused", "a process was not restarted in place, with the reason"
    RUN_SKIPPED = (
        "run_skipped",
        "the former run of the job has not ended at the time of the next one",
    )
    DEPENDENCY_RESTARTED = (
        "dependency_restarted",
        "the process is restarted, because a process after which it starts was restarted",
    )
    DEPENDANTS_LEFT = (
        "dependants_left",
        "the process is stopped before those that start after it, which did not end in time",
    )
    INSTANCE_ENDED = "instance_ended", "an instance that does not own the name of its process ended"
    UNASSIGNED_STOPPED = "unassigned_stopped", "a host runs an instance that the master stops"
    FENCED = "fenced", "a host runs an instance that has a successor: it is killed"
    GIVEN_UP = "given_up", "the host of the instance is lost, and the instance is given up"
    READOPTED = "readopted", "the lost host rejoined, and its instance owns the name again"
    SEPARATED = "separated", "the process no longer runs near another one, with the reason"
    PREEMPTED = "preempted", "the process makes room for one of a higher priority; facts: for, host"

    REPLACED = "replaced", "the process is stopped, and starts again in a new version"

    # --- applications --------------------------------------------------------------------

    APPLICATION_REQUESTED = "application_requested", "a client requests a version of an application"
    APPLICATION_APPLIED = "application_applied", "all processes of the application are as desired"
    APPLICATION_FAILED = "application_failed", "a process of the application fails, with the reason"
    APPLICATION_RETURNS = "application_returns", "a version failed: the former one is applied again"
    APPLICATION_CANCELLED = "application_cancelled", "all processes of the application have ended"

    # --- modes ---------------------------------------------------------------------------

    MODES_LOADED = "modes_loaded", "an operator loads modes"
    MODE_BEGINS = "mode_begins", "the cluster switches to a mode, with the reason"
    MODE_REACHED = "mode_reached", "all applications of the mode are as desired"
    MODE_FAILED = "mode_failed", "a mode cannot be reached, with the reason"

    # --- hosts ---------------------------------------------------------------------------

    HOST_REGISTERED = "host_registered", "a host registered; facts: labels, resources and devices"
    HOST_CHANGED = (
        "host_changed",
        "the slave describes its host in another way; facts: labels, resources, absent",
    )
    HOST_REFUSED = "host_refused", "a host was not registered, with the reason"
    HOST_SUSPECT = "host_suspect", "the host is silent and gets no new work"
    HOST_BACK = "host_back", "a silent host reports again"
    HOST_LOST = "host_lost", "the host was silent for its whole lease"
    HOST_LEFT = "host_left", "the slave stops, and its processes with it"
    HOST_DETACHED = "host_detached", "the slave stops and leaves its processes running"
    HOST_PRUNED = "host_pruned", "a departed host was removed from the listings"
    HOST_CORDONED = "host_cordoned", "a client cordoned the host: it gets no new work"
    HOST_UNCORDONED = "host_uncordoned", "a client uncordoned the host"
    HOST_DRAINING = "host_draining", "a client drains the host: its processes move away"
    HOST_DRAINED = "host_drained", "no process that can leave is left on the host"
    READING_REFUSED = "reading_refused", "a reading is not a number, is negative or is out of range"
    OVER_LIMIT = "over_limit", "the host reached a limit; facts: the resource"
    UNDER_LIMIT = "under_limit", "the host is under all its limits again"
    NOTHING_MOVES = "nothing_moves", "no process can leave the host, with the reasons"
    DEVICE_MISSING = "device_missing", "a device of the host is missing, with the reason"
    DEVICE_FOUND = "device_found", "a device that was missing is there again"
    REBALANCING = "rebalancing", "processes move to even out the load of the hosts; facts: moves"

    # --- migration -----------------------------------------------------------------------

    MIGRATION_BEGUN = "migration_begun", "a migration begins; facts: hosts, strategy, cause, steps"
    MIGRATION_STEP = "migration_step", "a step of the plan is done"
    MIGRATION_STEP_FAILED = "migration_step_failed", "a step of the plan failed, with the reason"
    MIGRATION_UNDONE = "migration_undone", "the migration turns back, with the reason"
    MIGRATION_REDONE = "migration_redone", "the destination is active: the migration is finished"
    MIGRATION_STUCK = "migration_stuck", "a step that must succeed failed: it is retried"
    MIGRATION_TAKEN_UP = "migration_taken_up", "a restarted master continues the migration"
    MIGRATION_FORGOTTEN = "migration_forgotten", "a restarted master cannot continue the migration"
    MIGRATION_REFUSED = "migration_refused", "a process is not moved as requested, with the reason"
    MIGRATED = "migrated", "the process moved; facts: hosts, seconds, blackout, cause, strategy"
    STAYED = "stayed", "the migration failed, and the process runs where it was"
    HANDOFF_REPORTED = "handoff_reported", "source or destination reports its phase of the handoff"
    TAKE_OVER = "take_over", "the source ended during the handoff: the destination takes over"
    DESTINATION_UNHEARD = (
        "destination_unheard",
        "the destination does not confirm the abort of the handoff: it is stopped",
    )
    SOURCE_STRANDED = (
        "source_stranded",
        "a source is silent for a handoff that is not under way: it resumes",
    )

    # --- snapshots and standbys ----------------------------------------------------------

    KEPT_ON = "kept_on", "the hosts for replicas of the snapshot were chosen"
    STANDBY_BEGUN = "standby_begun", "the standby starts on another host"
    STANDBY_READY = "standby_ready", "the standby is ready to take over"
    STANDBY_WAITS = "standby_waits", "no standby can be started now, with the reason"
    STANDBY_LOST = "standby_lost", "the standby ended; another one is started"
    FAILED_OVER = "failed_over", "the standby takes over from the process"

    # --- checkpoint images ---------------------------------------------------------------

    CHECKPOINT_BEGUN = "checkpoint_begun", "a client checkpoints the process; facts: steps"
    CHECKPOINTED = "checkpointed", "the process ended, and its image is on its host"
    CHECKPOINT_FAILED = "checkpoint_failed", "no image was made, and the process still runs"
    RESTORE_BEGUN = "restore_begun", "the process is restored from its image; facts: steps"
    RESTORED = "restored", "the process runs again from its image"
    RESTORE_FAILED = "restore_failed", "the process was not restored, and stays checkpointed"
    IMAGE_REMOVED = "image_removed", "an unwanted image was removed"
    IMAGE_LEFT = "image_left", "an image could not be removed: the removal is retried"
    PERIODIC_CHECKPOINT = "periodic_checkpoint", "the first periodic checkpoint was made"
    PERIODIC_FAILED = "periodic_failed", "no periodic checkpoint was made, with the reason"

    # --- plugins -------------------------------------------------------------------------

    PLUGIN_FAILED = "plugin_failed", "a plugin fails, with its error"
    PLUGIN_WORKS = "plugin_works", "a plugin that failed works again"
    STRATEGY_ABSENT = "strategy_absent", "a migration strategy does not work on a host"

    __str__ = str.__str__

    @classmethod
    def read(cls, text: str) -> EventKind:
        """Return the kind of a journalled event.

        A kind of another version of rosrm becomes a new member, so that its event is shown.
        """
        try:
            return cls(text)
        except ValueError:
            other = str.__new__(cls, text)
            other._name_ = other._value_ = text
            other.meaning = ""
            return other
