"""Subscriptions to slaves' unrequested messages (readings, statuses, usages), as core events."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from rosrm import clocks
from rosrm.core.master import events as happened
from rosrm.errors import Refused
from rosrm.keys.security import Authority, Peer
from rosrm.ros import convert, names, qos
from rosrm.ros.control import version_refusal
from rosrm.ros.master.reading_decoder import decode
from rosrm.ros.master.refusals import Refuse
from rosrm.ros.master.slave_links import HostLinks
from rosrm.ros.master.strangers import Strangers
from rosrm.ros.polling import polled_subscription, waiting
from rosrm.ros.sealed import SealedEndpoints
from rosrm.ros.sealed_readings import may_be_of_former_run, open_reading
from rosrm.wording import sanitized
from rosrm_msgs import msg

#: Most letters of the name of a failing plugin.
_LONGEST_PLUGIN: Final = 200


class SlaveSubscriptions:
    """The subscriptions to the messages of slaves, as events for `handle`.

    Args:
        links: receives the ids of hosts whose readings arrived.
        refuse: receives refused peers, and reasons.
        strangers: counts the messages without a valid key, also those that slaves report.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], links: HostLinks,
        handle: Callable[[happened.Event], None], refuse: Refuse, strangers: Strangers,
    ) -> None:  # fmt: skip
        self._endpoints = endpoints
        self._strangers = strangers
        self._links = links
        self._handle = handle
        self._refuse = refuse
        participant = endpoints.participant
        path = names.Names(participant.settings.namespace)
        self._topic = path(names.RESOURCE_INFO)
        # Thousands of readings arrive: they are taken raw, in batches, without the executor.
        intake = participant.unwatched_node(f"{participant.node.get_name()}_intake")
        self._readings = polled_subscription(intake, msg.SealedReading, self._topic, qos.READINGS)
        for kind, topic, take in (
            (msg.ProcessStatusBatch, names.PROCESS_STATUS, self._take_statuses),
            (msg.ProcessUsage, names.PROCESS_USAGE, self._take_usage),
            (msg.SnapshotReports, names.SNAPSHOT_REPORTS, self._take_snapshots),
        ):
            endpoints.subscribe(kind, path(topic), qos.STATUSES, self._of_host(take))

    def poll_readings(self) -> happened.ReadingsReceived | None:
        """Take all received readings; None: there are none."""
        run, slave_of = self._endpoints.security.run, self._links.slave_of
        taken = []
        for sealed, _ in waiting(self._readings, qos.READINGS.depth):
            plain = open_reading(sealed, run, slave_of)
            if plain is not None:
                taken.append(plain)
            elif not may_be_of_former_run(sealed, slave_of, clocks.boot_time()):
                self._endpoints.refused(self._topic)
        if not taken:
            return None
        batch = decode(taken)
        if batch.runs is not None:
            received = self._links.reading_stats.take(batch.runs, clocks.boot_time())
            self._links.reading_received(received.tolist())
        for refusal in batch.refusals:
            self._refuse("resource_info", "resource_info", refusal)
        return batch.readings

    def _of_host(self, take: Callable[[Any], None]) -> Callable[[Any, Peer], None]:
        """Wrap a callback: pass on messages about a host only from the slave of this host."""

        def take_own(message: Any, sender: Peer) -> None:
            if self._links.is_slave_of(message.host_id, sender):
                take(message)
            else:
                who = str(sender.grant.principal)
                reason = f"{who} is not the slave of host {message.host_id}"
                self._refuse("other_host", who, reason)

        return take_own

    def _take_statuses(self, message: msg.ProcessStatusBatch) -> None:
        who = f"process_status of host {message.host_id}"
        fault = version_refusal(message.protocol_version, who)
        if fault:
            self._refuse("process_status", who, fault)
            return
        slave = self._links.slave_of(message.host_id)
        if message.strangers and slave is not None:
            topics = f"the topics of {slave.peer.grant.principal}"
            self._strangers.note(topics, message.strangers)
        try:
            statuses = tuple(convert.status_from_msg(status) for status in message.statuses)
            devices = convert.devices_from_msg(message.devices)
        except Refused as refusal:
            self._refuse("process_status", who, str(refusal))
            return
        probes, strategies, launchers = (
            _failing(message, kind) for kind in ("probe", "migration", "launcher")
        )
        self._handle(
            happened.StatusesReceived(
                message.host_id, message.incarnation, message.sequence, message.complete, statuses,
                probes, strategies, launchers, devices,
            )
        )  # fmt: skip

    def _take_usage(self, message: msg.ProcessUsage) -> None:
        others = {one.slot: np.asarray(one.amounts, np.float64) for one in message.others}
        sizes = {len(message.numbers), len(message.cpu), len(message.memory)}
        sizes |= {len(amounts) for amounts in others.values()}
        who = f"process_usage of host {message.host_id}"
        fault = version_refusal(message.protocol_version, who)
        if fault or len(sizes) > 1:
            self._refuse("process_usage", who, fault or "arrays of different lengths")
            return
        self._handle(
            happened.UsagesReceived(
                message.host_id, message.incarnation, np.asarray(message.numbers, np.uint64),
                np.asarray(message.cpu, np.float64), np.asarray(message.memory, np.float64), others,
            )
        )  # fmt: skip

    def _take_snapshots(self, message: msg.SnapshotReports) -> None:
        who = f"snapshot_reports of host {message.host_id}"
        fault = version_refusal(message.protocol_version, who)
        if fault:
            self._refuse("snapshot_reports", who, fault)
            return
        try:
            states = tuple(convert.snapshot_from_msg(one) for one in message.snapshots)
        except Refused as refusal:
            self._refuse("snapshot_reports", who, str(refusal))
            return
        self._handle(happened.SnapshotsReported(message.host_id, message.incarnation, states))


def _failing(message: msg.ProcessStatusBatch, kind: str) -> dict[str, str]:
    return {
        sanitized(row.name, _LONGEST_PLUGIN): sanitized(row.reason)
        for row in message.failing
        if row.kind == kind
    }
