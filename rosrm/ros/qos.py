"""Quality of service of every topic and service, in one place."""

from __future__ import annotations

from typing import Final

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

#: Room for requests of a thousand slaves at once; the default keeps 10 and silently drops others.
SERVICE: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.RELIABLE
)

#: Best effort, because the next reading replaces a lost one. The depth is for all hosts.
READINGS: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=4000, reliability=ReliabilityPolicy.BEST_EFFORT
)

#: A sender keeps only its newest reading.
READING_OUT: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)

#: Reliable and in order; the receiver detects a gap by sequence, and requests the missing part.
STATUSES: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.RELIABLE
)

#: One topic for all hosts: a late subscriber receives the newest beat at once.
BEAT: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)  # fmt: skip

#: For subscribers that need no repetition of a lost beat, because the next one follows soon. A
#: thousand reliable readers would each acknowledge each beat.
BEAT_IN: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)

#: For observers of the master's load.
LOAD: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=5, reliability=ReliabilityPolicy.RELIABLE
)

#: The master's newest messages about every handoff; a late subscriber receives them at once.
STATE_CONFIG: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)  # fmt: skip

#: One handoff: a restarted master receives the reports that it has missed.
HANDOFF: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=20, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)  # fmt: skip
