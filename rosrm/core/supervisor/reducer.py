"""The supervisor's reducer for the instances of one host: a pure state machine.

    phase     event            what follows                                  next phase
    -         StartOrdered     Spawn                                         starting
                               its number is dead, or all is stopped: -      refused
    -         StopOrdered      - (a start that comes late is refused)        refused
              FenceOrdered     -                                             refused
              RestartOrdered   -                                             refused
              AmendOrdered     -                                             refused
    starting  Spawned          -                                             running
                               a stop came in between: SIGINT                stopping
              SpawnFailed      this host cannot start it: -                  refused
                               transient: by policy                          failed, backoff
              StopOrdered      Unspawn (one in hand is stopped later)        starting
              FencePassed      Unspawn (one in hand is stopped later)        starting
              FenceOrdered     Unspawn (one in hand is killed later)         starting
              Resumed          Spawn (the supervisor was restarted)          starting
              AmendOrdered     - (its policy is another from now on)         starting
    running   Exited           by policy                                     exited, failed, backoff
                               others of its session live: SIGINT            stopping
              StopOrdered      SIGINT                                        stopping
              FencePassed      SIGINT; dead within the grace of its fence    stopping
              FenceOrdered     SIGKILL                                       stopping
              RestartOrdered   SIGINT, to start again afterwards             stopping
              FailOrdered      SIGINT, or SIGKILL at once; then by policy    stopping
              AmendOrdered     -                                             running
    stopping  TimePassed       SIGTERM, then SIGKILL, then SIGKILL again     stopping
              Exited           as was meant (end, restart, policy)           exited, starting, ...
                               others of its session live: -                 stopping
              Cleared          as was meant (end, restart, policy)           exited, starting, ...
              StopOrdered      now it is meant to end                        stopping
              FencePassed      now it is meant to end, in the grace          stopping
              FenceOrdered     the same; SIGKILL                             stopping
              RestartOrdered   unless it is meant to end: to start again     stopping
              AmendOrdered     -                                             stopping
    backoff   TimePassed       Spawn                                         starting
              RestartOrdered   Spawn, the count of restarts afresh           starting
              StopOrdered      -                                             exited
              FencePassed      -                                             fenced
              FenceOrdered     -                                             fenced
              AmendOrdered     - (if the policy now allows no restart)       failed, backoff
    ended     Forgotten        Drop; its number is dead                      -

An instance may have a fence: `FencePassed` follows without an order when the last contact with the
master (`Heard`; the start counts as one) is too long ago. Where the fence is `alive`, a running
slave counts as contact. A fenced instance is not restarted here, whatever its policy and whatever
is ordered afterwards.

`ShutdownOrdered` stops every instance as `StopOrdered` does. An instance that no order had stopped
before ends as withdrawn, not exited, so that the master knows: neither the process nor the master
ended it.

`ClientLost` changes nothing: each instance keeps running as long as its fence allows.

An event that is not in the table changes nothing. An order that changes nothing has its status
reported again, because DDS may repeat it. Every change of an instance is reported (`Tell`). A
signal goes to every process that is left of an instance, and none is sent after its end.

The supervisor imports this package and must stay small. So the package uses nothing of
`rosrm.model.values` (dataclasses alone cost 2 MiB); a test compares the values that are in both.
"""

from __future__ import annotations

from rosrm.core.supervisor.commands import Command, Drop, Leave, Signal, Spawn, Tell, Unspawn
from rosrm.core.supervisor.events import (
    AmendOrdered,
    Cleared,
    ClientLost,
    Event,
    Exited,
    FailOrdered,
    FenceOrdered,
    FencePassed,
    Forgotten,
    Heard,
    RestartOrdered,
    Resumed,
    ShutdownOrdered,
    Spawned,
    SpawnFailed,
    StartOrdered,
    StopOrdered,
    TimePassed,
)
from rosrm.core.supervisor.instance import (
    BACKOFF,
    ENDED,
    EXITED,
    FAILED,
    FENCED,
    KILL_AGAIN,
    MOST_KILLS,
    REFUSED,
    RUNNING,
    STARTING,
    STEPS,
    STOPPING,
    THEN_END,
    THEN_POLICY,
    THEN_RESTART,
    UNKNOWN_EXIT,
    WITHDRAWN,
    Instance,
    signal_name,
)
from rosrm.core.supervisor.instances import MOST_TOMBSTONES, Supervision
from rosrm.core.supervisor.rules import FenceRule, Key, RestartRule, StopRule
from rosrm.core.supervisor.transitions import TRANSITIONS, Transition, backoff

__all__ = [
    "BACKOFF",
    "ENDED",
    "EXITED",
    "FAILED",
    "FENCED",
    "KILL_AGAIN",
    "MOST_KILLS",
    "MOST_TOMBSTONES",
    "REFUSED",
    "RUNNING",
    "STARTING",
    "STEPS",
    "STOPPING",
    "THEN_END",
    "THEN_POLICY",
    "THEN_RESTART",
    "TRANSITIONS",
    "UNKNOWN_EXIT",
    "WITHDRAWN",
    "AmendOrdered",
    "Cleared",
    "ClientLost",
    "Command",
    "Drop",
    "Event",
    "Exited",
    "FailOrdered",
    "FenceOrdered",
    "FencePassed",
    "FenceRule",
    "Forgotten",
    "Heard",
    "Instance",
    "Key",
    "Leave",
    "RestartOrdered",
    "RestartRule",
    "Resumed",
    "ShutdownOrdered",
    "Signal",
    "Spawn",
    "SpawnFailed",
    "Spawned",
    "StartOrdered",
    "StopOrdered",
    "StopRule",
    "Supervision",
    "Tell",
    "TimePassed",
    "Transition",
    "Unspawn",
    "backoff",
    "signal_name",
]
