"""The network of a lab: a bridge in a namespace of its own, and a cable from it to each host.

The bridge has no address and no other link, so that no packet of a host leaves the lab.
"""

from __future__ import annotations

import contextlib
import errno
import subprocess
from collections.abc import Iterator, Mapping
from ipaddress import IPv4Network
from typing import TYPE_CHECKING, Any, Final

from pyroute2 import IPRoute, NetlinkError, netns

from rosrm.errors import LabError
from rosrm_lab import plan as names
from rosrm_lab.needs import find_command
from rosrm_lab.plan import LabPlan
from rosrm_lab.wires import Link, Wire, ruleset

if TYPE_CHECKING:
    from collections.abc import Iterable

_BRIDGE: Final = "bridge"
#: Name of a host's one interface, in the host.
INTERFACE: Final = "eth0"
_MAIN_TABLE: Final = 254
#: TC_H_ROOT: pyroute2's own `root=True` also requires a handle, which a deletion must not have.
_ROOT: Final = 0xFFFFFFFF
_IPV4: Final = 2


@contextlib.contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turn an error of the kernel, or of a container's rules, into a `LabError`.

    Args:
        what: the failed action, for the message.
    """
    try:
        yield
    except (NetlinkError, OSError, RuntimeError) as error:  # the last: pyroute2's child was killed
        raise LabError(
            f"{what}: {_reason(error)}. A lab needs network namespaces, bridges and veth pairs: "
            "`modprobe -a bridge veth` brings what the kernel has as modules; a container needs "
            "`docker run --privileged`"
        ) from error


@_explained("the network namespaces of this machine cannot be listed")
def existing() -> list[str]:
    """Return all named network namespaces of this machine."""
    return list(netns.listnetns())


@_explained("the address ranges of this machine cannot be read")
def ranges_in_use() -> list[tuple[IPv4Network, str]]:
    """Return the address ranges that this machine reaches directly or by a route, with the link."""
    found = []
    with IPRoute() as machine:
        interfaces = {link["index"]: link.get("ifname") for link in machine.get_links()}
        for route in machine.get_routes(family=_IPV4, table=_MAIN_TABLE):
            target = route.get("dst")
            if target:  # the default route has no range
                owner = interfaces.get(route.get("oif"), "a route of this machine")
                found.append((IPv4Network(f"{target}/{route['dst_len']}"), f"{owner}"))
    return found


@_explained("the bridge between the hosts cannot be made")
def make_switch(lab: LabPlan) -> None:
    """Make the namespace with the bridge."""
    name = names.switch_namespace(lab.name)
    netns.create(name)
    with IPRoute(netns=name) as switch:
        # The lab has no querier, so that snooping would forget the receivers of multicast.
        switch.link("add", ifname=_BRIDGE, kind="bridge", br_mcast_snooping=0, br_stp_state=0)
        switch.link("set", index=_index(switch, _BRIDGE), state="up")


@_explained("a host cannot be connected to the bridge")
def plug_in(lab: LabPlan, host: str, link: Link) -> None:
    """Make a host's namespace, and the cable to the switch.

    Args:
        link: faults of the cable from the beginning.
    """
    name, port = names.host_namespace(lab.name, host), lab.port(host)
    netns.create(name)
    with IPRoute(netns=names.switch_namespace(lab.name)) as switch, IPRoute(netns=name) as inside:
        peer = {"ifname": INTERFACE, "net_ns_fd": name, "address": lab.mac(host)}
        switch.link("add", ifname=port, kind="veth", peer=peer)
        switch.link("set", index=_index(switch, port), master=_index(switch, _BRIDGE), state="up")
        mine = _index(inside, INTERFACE)
        inside.addr(
            "add",
            index=mine,
            address=str(lab.address(host)),
            prefixlen=lab.subnet.prefixlen,
            broadcast=str(lab.subnet.broadcast_address),
        )
        for index in (_index(inside, "lo"), mine):
            inside.link("set", index=index, state="up")
    if Link() != link:
        set_delays(lab, host, Link(), link)


@_explained("a host cannot be taken off the bridge")
def unplug(lab: LabPlan, host: str) -> None:
    """Remove a host's cable, so that packets of its dying processes reach no other host."""
    if names.switch_namespace(lab.name) not in existing():
        return
    with IPRoute(netns=names.switch_namespace(lab.name)) as switch:
        for index in switch.link_lookup(ifname=lab.port(host)):
            switch.link("del", index=index)


@_explained("a network namespace cannot be removed")
def remove(namespaces: Iterable[str]) -> None:
    """Remove namespaces with their content."""
    for name in namespaces:
        with contextlib.suppress(FileNotFoundError):
            netns.remove(name)


def set_rules(lab: LabPlan, links: Mapping[str, Link]) -> None:
    """Apply cuts and losses, all at once.

    Args:
        links: by host.

    Raises:
        LabError: nft is missing, or the kernel refuses.
    """
    nft = find_command("nft")
    switch = names.namespace_path(names.switch_namespace(lab.name))
    rules = ruleset({lab.port(host): link for host, link in links.items()})
    command = [find_command("nsenter"), f"--net={switch}", "--", nft, "-f", "-"]
    done = subprocess.run(command, input=rules, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LabError(
            f"the firewall of lab {lab.name!r} could not be set, and nothing was changed: "
            f"{done.stderr.strip()}"
        )


@_explained("the packets of a host cannot be delayed")
def set_delays(lab: LabPlan, host: str, before: Link, after: Link) -> None:
    """Delay the packets to and from a host.

    Raises:
        LabError: the kernel has no netem; nothing was changed.
    """
    ends = (
        (names.switch_namespace(lab.name), lab.port(host), before.incoming, after.incoming),
        (names.host_namespace(lab.name, host), INTERFACE, before.outgoing, after.outgoing),
    )
    with contextlib.ExitStack() as undo:
        for name, interface, old, new in ends:
            if old.delay != new.delay:
                _set_delay(name, interface, new)
                undo.callback(_set_delay, name, interface, old)
        undo.pop_all()


def _set_delay(name: str, interface: str, wire: Wire) -> None:
    with IPRoute(netns=name) as namespace:
        index = _index(namespace, interface)
        try:
            if wire.delay:
                # limit: packets in transit; netem drops more than that.
                namespace.tc(
                    "replace", "netem", index=index, delay=round(wire.delay * 1e6), limit=100_000
                )
            else:
                namespace.tc("del", index=index, parent=_ROOT)
        except NetlinkError as error:
            if error.code in (errno.ENOENT, errno.EOPNOTSUPP):
                raise LabError(
                    "this kernel cannot delay packets: it has no netem (CONFIG_NET_SCH_NETEM, on "
                    "Debian and Ubuntu the module sch_netem: `modprobe sch_netem`). Nothing was "
                    "changed"
                ) from None
            raise


def _reason(error: Exception) -> str:
    """Return the text of an error; both kinds of errors carry a number and a text."""
    number = error.args[0] if error.args else None
    if len(error.args) < 2 or not isinstance(number, int):
        return str(error)
    return f"{error.args[1]} ({errno.errorcode.get(number, number)})"


def _index(connection: Any, interface: str) -> int:
    return int(connection.link_lookup(ifname=interface)[0])
