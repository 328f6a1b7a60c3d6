"""The program `count` of `benchmarks.handoff_nodes`, whose node answers inputs as well.

Each cycle has one output, [instance, sequence, input]; the input of a cycle of the timer is 0.
"""

from __future__ import annotations

import sys

from std_msgs.msg import Int64, Int64MultiArray

from benchmarks import handoff_nodes
from benchmarks.handoff_nodes import INPUT, QOS, instance


class CountAndAnswer(handoff_nodes.Count):
    def __init__(self, rate: float) -> None:
        super().__init__(rate)
        self.create_subscription(Int64, INPUT, lambda message: self.tick(message.data), QOS)

    def tick(self, answered: int = 0) -> None:
        self.sequence += 1
        self.output.publish(Int64MultiArray(data=[instance(), self.sequence, answered]))


handoff_nodes.Count = CountAndAnswer
handoff_nodes.main(sys.argv)
