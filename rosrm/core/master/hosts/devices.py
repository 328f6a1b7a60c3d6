"""Changes of the devices of a host, as its slave reports them."""

from __future__ import annotations

from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import Host
from rosrm.model.description_checks import LARGEST_DESCRIPTION
from rosrm.model.devices import Device
from rosrm.model.event_kinds import EventKind
from rosrm.model.sizes import size_of


def note_devices(state: MasterState, host: Host, devices: tuple[Device, ...], now: float) -> None:
    """Note the devices of a host, and record those that went missing or are there again."""
    before = {(one.kind, one.unit): one for one in host.description.devices}
    if devices == host.description.devices or size_of(devices) > LARGEST_DESCRIPTION:
        return
    state.hosts.set_devices(host, devices)
    for device in devices:
        known = before.get((device.kind, device.unit))
        if known is not None and bool(known.missing) is not bool(device.missing):
            _record(state, host, device, now)


def _record(state: MasterState, host: Host, device: Device, now: float) -> None:
    kind, outcome = EventKind.DEVICE_FOUND, "is there again"
    if device.missing:
        holders = state.hosts.devices[host.column].holders_of((device.kind, device.unit))
        held = "".join(f"; {holder} holds it" for holder in holders)
        kind, outcome = EventKind.DEVICE_MISSING, f"is missing: {device.missing}{held}"
    state.record(
        now, kind, f"{device.title} on {host.name} {outcome}", host=host.name,
        facts={"device": device.kind, "unit": device.unit},
    )  # fmt: skip
