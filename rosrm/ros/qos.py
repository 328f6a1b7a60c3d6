"""The quality of service of every topic and service, in one place."""

from __future__ import annotations

from typing import Final

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

#: Requests of a thousand slaves at once; the default keeps the last 10 and drops silently.
SERVICE: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.RELIABLE
)

#: Newest counts: a reading that is lost is followed by the next. The depth is for all hosts.
READINGS: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=4000, reliability=ReliabilityPolicy.BEST_EFFORT
)

#: The sender keeps no more readings than the newest.
READING_OUT: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)

#: What must arrive, in order; a gap is noticed by sequence and asked for.
STATUSES: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.RELIABLE
)

#: One for all: who comes late hears the newest at once.
BEAT: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)  # fmt: skip

#: For those that need no word of a beat that was lost: the next one comes soon. A thousand reliable
#: readers would each acknowledge each beat.
BEAT_IN: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)

#: Whoever looks at how the master keeps up.
LOAD: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=5, reliability=ReliabilityPolicy.RELIABLE
)

#: The newest words of the master about every handoff: who comes late hears them at once.
STATE_CONFIG: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)  # fmt: skip

#: One handoff: a master that was started anew hears what it has missed.
HANDOFF: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=20, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)  # fmt: skip
