"""A charging dock that can migrate while robots charge at it.

Each order adds charge to one bay. A fast loop delivers to the bay with the largest pending charge,
by at most `limit`, while there is a supply. A slow loop reports.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rclpy
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Float64, Float64MultiArray, Int64MultiArray
from std_srvs.srv import Trigger

from rosrm.node import Node, arrays_message, arrays_of
from rosrm_msgs.msg import Arrays

PERIOD = 0.05
ARRAYS = ("pending", "orders", "history")


class Dock(Node):
    """A dock that charges what was ordered, bay by bay.

    Subscribes:
        orders: [number, bay, mAs]; each counts.
        voltage: of the supply; only the newest counts.

    Publishes:
        current: [sequence, mA, volts, readings, limit], 20 times a second, best effort.
        receipts: [number, number of the order, orders in all bays], one for each order.
        ~/health: [number, orders, readings, reservations, mAs to be delivered], every second.

    Serves:
        reserve: answers with the number of the reservation.
    """

    def __init__(self) -> None:
        """Begin with empty bays."""
        super().__init__("dock")
        fixed = ParameterDescriptor(read_only=True)
        self.bays: int = self.declare_parameter("bays", 4, fixed).value
        self.limit: float = self.declare_parameter("limit", 500.0).value
        self.add_on_set_parameters_callback(self.check_parameters)
        self.add_post_set_parameters_callback(self.take_parameters)

        self.sequence = self.receipts = self.reports = self.readings = self.reservations = 0
        self.volts = 0.0
        self.pending = np.zeros(self.bays)
        self.orders = np.zeros(self.bays, dtype=np.int64)
        self.history = np.zeros((0, 2))
        self.bays_changed = True

        sensor = qos_profile_sensor_data
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.current_out = self.create_publisher(Float64MultiArray, "current", sensor)
        self.receipts_out = self.create_publisher(Int64MultiArray, "receipts", 1000)
        self.health_out = self.create_publisher(Float64MultiArray, "~/health", latched)
        self.create_subscription(Int64MultiArray, "orders", self.on_order, 1000)
        self.create_subscription(Float64, "voltage", self.on_voltage, sensor, buffer=False)
        self.create_service(Trigger, "reserve", self.reserve)
        self.create_timer(PERIOD, self.control)
        self.create_timer(1.0, self.report)

        self.keep_state("~/state", Float64MultiArray, self.save, self.restore)
        self.keep_state("~/bays", Arrays, self.save_bays, self.restore_bays)

    def check_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Refuse a limit that would harm the batteries."""
        fine = all(0 <= p.value <= 5000 for p in parameters if p.name == "limit")
        return SetParametersResult(successful=fine, reason="" if fine else "0 to 5000 mA")

    def take_parameters(self, parameters: Sequence[Parameter]) -> None:
        """Apply the new limit from the next control cycle on."""
        self.limit = next((p.value for p in parameters if p.name == "limit"), self.limit)

    def on_order(self, order: Int64MultiArray) -> None:
        """Book an order and confirm it."""
        number, bay, charge = order.data
        self.pending[bay % self.bays] += charge
        self.orders[bay % self.bays] += 1
        self.bays_changed = True
        self.receipts += 1
        receipt = [self.receipts, number, int(self.orders.sum())]
        self.receipts_out.publish(Int64MultiArray(data=receipt))

    def on_voltage(self, voltage: Float64) -> None:
        """Store the newest reading."""
        self.volts = voltage.data
        self.readings += 1

    def reserve(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Count a reservation."""
        self.reservations += 1
        answer.success, answer.message = True, str(self.reservations)
        return answer

    def control(self) -> None:
        """Deliver to the bay with the largest pending charge."""
        bay = int(self.pending.argmax())
        delivered = min(self.pending[bay], self.limit * PERIOD) if self.volts else 0.0
        if delivered:
            self.pending[bay] -= delivered
            self.bays_changed = True
        self.sequence += 1
        values = [self.sequence, delivered / PERIOD, self.volts, self.readings, self.limit]
        self.current_out.publish(Float64MultiArray(data=[*map(float, values)]))

    def report(self) -> None:
        """Sum up the pending charge, and append it to the history."""
        self.reports += 1
        left = self.pending.sum()
        self.history = np.vstack([self.history, [self.volts, left]])[-600:]
        self.bays_changed = True
        values = [self.reports, self.orders.sum(), self.readings, self.reservations, left]
        self.health_out.publish(Float64MultiArray(data=[*map(float, values)]))

    def save(self) -> Float64MultiArray:
        """Return the counters and the last reading."""
        counts = [self.sequence, self.receipts, self.reports, self.readings, self.reservations]
        return Float64MultiArray(data=[*map(float, counts), self.volts])

    def restore(self, state: Float64MultiArray) -> None:
        """Restore the counters and the last reading."""
        *counts, self.volts = state.data
        whole = map(int, counts)
        self.sequence, self.receipts, self.reports, self.readings, self.reservations = whole

    def save_bays(self) -> Arrays | None:
        """Return the pending charge of each bay, if changed."""
        changed, self.bays_changed = self.bays_changed, False
        return arrays_message({name: getattr(self, name) for name in ARRAYS}) if changed else None

    def restore_bays(self, message: Arrays) -> None:
        """Restore the pending charge of each bay."""
        for name, array in arrays_of(message).items():
            setattr(self, name, array)


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Dock())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
