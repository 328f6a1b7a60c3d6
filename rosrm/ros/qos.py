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
#: As the master keeps them for nodes that join: two for each phase, one for each node. Fast DDS
#: sends all of them to each new reader, and with each one a heartbeat to every node. The 600
#: packets of 200 messages overflowed the socket of a busy source, whose inputs then stopped until
#: their publisher's next heartbeat (3 s). The master repeats a phase without a reply.
STATE_CONFIG_OUT: Final = latched(depth=20)
#: One handoff: a restarted master receives the reports that it has missed.
HANDOFF: Final = latched(depth=20)
