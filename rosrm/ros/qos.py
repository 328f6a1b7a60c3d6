"""Quality of service of every topic and service, in one place."""

from __future__ import annotations

from functools import partial
from typing import Final

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

best_effort: Final = partial(
    QoSProfile, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT
)
reliable: Final = partial(
    QoSProfile, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)
#: A late subscriber receives the newest messages at once.
latched: Final = partial(reliable, durability=DurabilityPolicy.TRANSIENT_LOCAL)

#: Room for requests of a thousand slaves at once; the default keeps 10 and silently drops others.
SERVICE: Final = reliable(depth=2000)
#: Best effort, because the next reading replaces a lost one. The depth is for all hosts.
READINGS: Final = best_effort(depth=4000)
#: A sender keeps only its newest reading.
READING_OUT: Final = best_effort(depth=1)
#: Reliable and in order; the receiver detects a gap by sequence, and requests the missing part.
STATUSES: Final = reliable(depth=2000)
#: One topic for all hosts.
BEAT: Final = latched(depth=1)
#: For subscribers that need no repetition of a lost beat, because the next one follows soon. A
#: thousand reliable readers would each acknowledge each beat.
BEAT_IN: Final = best_effort(depth=1)
#: For observers of the master's load.
LOAD: Final = reliable(depth=5)
#: As the publishers of ROS's own package diagnostic_updater.
DIAGNOSTICS: Final = reliable(depth=10)
#: The master's messages about every handoff, as a node receives them.
STATE_CONFIG: Final = latched(depth=200)
#: The same messages in the history of the master's writer, for nodes that join later. Each phase
#: has two messages, one to each of the two nodes. Fast DDS sends the whole history to each new
#: reader, and with each message a heartbeat to every node. With a depth of 200 these were 600
#: packets. They overflowed the socket of a busy source, which then received no input until the
#: next heartbeat of its publisher (3 s). A node may miss older messages without harm: the master
#: repeats a phase until its reply, repeats a SHADOW without a reply while the next step waits for
#: an executor or for a report, and replaces the READY standby of a primary that was restarted.
STATE_CONFIG_OUT: Final = latched(depth=20)
#: One handoff: a restarted master receives the reports that it has missed.
HANDOFF: Final = latched(depth=20)
