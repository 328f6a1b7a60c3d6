"""`Lab`: several virtual hosts on this machine: creation, use, faults and removal."""

# pyroute2 takes longer to import than `exec` takes in all: only network changes import it.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from ipaddress import IPv4Network
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

from rosrm.errors import ConfigError, LabError
from rosrm.supervisor.procfs import boot_id
from rosrm.wording import ending_of
from rosrm_lab import groups, needs, store
from rosrm_lab.host import DATA, entrance
from rosrm_lab.plan import HostPlan, LabPlan, check_name, check_usable, switch_namespace
from rosrm_lab.status import HostStatus, host_status
from rosrm_lab.store import Birth, LabRecord
from rosrm_lab.wires import Direction, check_delay, check_loss, check_rate

if TYPE_CHECKING:
    from typing_extensions import Self

DEFAULT_NAME: Final = "lab"

File = int | IO[Any] | None


class Lab:
    """Virtual hosts in one network of their own; as a context manager it removes them at the end.

    ::

        with Lab("test", uniform(2, memory=GIB, cpu=0.5) + [HostPlan("desk")]) as lab:
            lab.exec("host1", ["hostname"])
            lab.cut("host2", "in")

    A lab counts as abandoned when the process of its `with` block was killed: the next lab of its
    name removes it first. A lab made by `up` stays until `down`.

    Args:
        name: of the lab.
        hosts: to be made; none for a lab that is up.
        subnet: IPv4 range of their addresses; None: a free one.

    Attributes:
        name: of the lab.
    """

    def __init__(
        self,
        name: str = DEFAULT_NAME,
        hosts: Sequence[HostPlan] = (),
        *,
        subnet: IPv4Network | None = None,
    ) -> None:
        check_name(name, "lab")
        if subnet is not None:
            check_usable(subnet)
        self.name: Final = name
        self._hosts = tuple(hosts)
        self._subnet = subnet
        self._known: list[groups.Hierarchy] | None = None

    # --- begin and end ------------------------------------------------------------------------

    def up(self, *, owner: Birth | None = None, between: Callable[[], None] = lambda: None) -> None:
        """Make the lab; the remains of a killed attempt are removed first.

        Args:
            owner: the process whose end makes the lab an abandoned one.
            between: called before each host and after the last; its exception undoes everything
                made so far.

        Raises:
            LabError: it is up already, or something is missing on this machine; nothing is left.
            ConfigError: the hosts or the subnet are impossible.
        """
        from rosrm_lab import making

        needs.check_rights(self._hosts)
        with making.explained(self.name), store.lock(self.name):
            making.refuse_if_up(self.name)
            making.remove(self._hierarchies, self.name)
            # Not before, because the remains of a killed attempt take memory and disk space.
            needs.check_machine(self._hosts, store.IMAGES, self._hierarchies)
            try:
                with store.lock(""):  # two labs at once must not choose the same addresses
                    subnet = making.choose_subnet(self._subnet)
                    plan = LabPlan(self.name, self._hosts, subnet)
                    record = LabRecord(plan, boot=boot_id(), owner=owner)
                    store.write(record)
                making.make(self._hierarchies, record, between)
            except BaseException as first:  # a signal raises one, too; no part may stay
                _undo(first, lambda: making.remove(self._hierarchies, self.name))
                raise

    def down(self) -> bool:
        """Remove the lab: end its processes, delete its disks. False: there was nothing to remove.

        Raises:
            LabError: something could not be removed; a second call continues.
        """
        from rosrm_lab import making

        needs.check_rights()
        with making.explained(self.name), store.lock(self.name):
            return making.remove(self._hierarchies, self.name)

    def __enter__(self) -> Self:
        """Make the lab; it counts as abandoned when this process has ended."""
        self.up(owner=Birth.of(os.getpid()))
        return self

    def __exit__(self, *_: object) -> None:
        _to_the_end(self.down)

    # --- queries ------------------------------------------------------------------------------

    @property
    def plan(self) -> LabPlan:
        """Return the plan of the lab; raises `LabError` where it is not up."""
        return self._record().plan

    def address(self, host: str) -> str:
        """Return a host's IPv4 address in the lab."""
        return str(self.plan.address(host))

    def is_up(self, host: str) -> bool:
        """Return True if a host is switched on."""
        record = self._record()
        return record.is_up(record.plan.host(host).name)

    def status(self) -> list[HostStatus]:
        """Return the status of each host."""
        record = self._record()
        return [host_status(self._hierarchies, record, host) for host in record.plan.hosts]

    def outside(self, host: str, path: str | Path) -> Path:
        """Return the path on this machine of a host's file, valid while the host is up.

        Args:
            path: as seen by the host; a relative one is on its disk.
        """
        record = self._record()
        if not record.is_up(record.plan.host(host).name):
            raise LabError(f"host {host} of lab {self.name!r} is off: its files are out of reach")
        return record.outside(host, DATA / path)

    def group(self, host: str) -> str:
        """Return the control group with a host's limits, for the option `group` of a probe."""
        self.plan.host(host)
        hierarchy = self._hierarchies[0]
        limited = hierarchy.group(self.name, host, "limited")
        return f"/{limited.relative_to(hierarchy.mount)}"

    def pids(self, host: str) -> set[int]:
        """Return the pids on this machine of the processes that were started on a host."""
        self.plan.host(host)
        return groups.processes(self._hierarchies, self.name, host)

    # --- commands on a host -------------------------------------------------------------------

    def popen(  # noqa: PLR0913 - see below: most are Popen's
        self,
        host: str,
        command: Sequence[str],
        *,
        limited: bool = True,
        user: str = "",
        env: Mapping[str, str] | None = None,
        cwd: str | None = None,
        stdin: File = None,
        stdout: File = None,
        stderr: File = None,
        pass_fds: Sequence[int] = (),
    ) -> subprocess.Popen[bytes]:
        """Start a command on a host; the other arguments are those of `subprocess.Popen`.

        The returned process is a relay: signals reach the command, its exit status is the
        command's, and killing it kills the command.

        Args:
            limited: it counts against the host's memory and CPU; False: it is on the host, but
                outside its limits.
            user: to run as; "": as this process.
            env: variables on top of this process's and the host's.
            cwd: directory to start in; None: this process's.
        """
        way = entrance(
            self._hierarchies,
            self._record(),
            host,
            command,
            leaf="limited" if limited else "free",
            user=user,
            environment=env,
            directory=cwd,
        )
        try:
            return subprocess.Popen(
                way.command,
                env=way.environment,
                stdin=stdin,
                stdout=stdout,
                stderr=stderr,
                pass_fds=[*way.descriptors, *pass_fds],
            )
        finally:
            for descriptor in way.descriptors:
                os.close(descriptor)

    def exec(
        self,
        host: str,
        command: Sequence[str],
        *,
        limited: bool = True,
        user: str = "",
        env: Mapping[str, str] | None = None,
        input: str | None = None,  # noqa: A002 - as subprocess.run calls it
        timeout: float = 60.0,
        check: bool = True,
    ) -> subprocess.CompletedProcess[str]:
        """Run a command on a host to its end, and return its output.

        Args:
            input: for its standard input.
            timeout: seconds, after which it is killed and `subprocess.TimeoutExpired` raised.
            check: raise `LabError` where it fails.
        """
        process = self.popen(
            host,
            command,
            limited=limited,
            user=user,
            env=env,
            stdin=subprocess.DEVNULL if input is None else subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        with process:
            try:
                out, err = process.communicate((input or "").encode() or None, timeout)
            except BaseException:  # the program must not outlive a signal to this one
                process.kill()
                raise
        said, troubles = out.decode(errors="replace"), err.decode(errors="replace")
        if check and process.returncode:
            raise LabError(
                f"{command[0]} on {host}: {ending_of(process.returncode)}: "
                f"{troubles.strip() or said.strip() or 'it printed nothing'}"
            )
        return subprocess.CompletedProcess(list(command), process.returncode, said, troubles)

    def supervise(self, host: str, state: str, timeout: float = 60.0) -> None:
        """Start a supervisor within a host's limits, for a slave outside of them.

        Processes are children of the supervisor, so they are within the limits too; a slave that is
        started with this state directory finds the supervisor there.

        Args:
            state: directory of the slave, as seen by the host.
            timeout: seconds for it to start, as for `exec`.
        """
        command = [sys.executable, "-m", "rosrm.supervisor", "--state", f"{state}/supervisor"]
        self.exec(host, command, timeout=timeout)

    def become(
        self, host: str, command: Sequence[str], *, user: str = "", env: Mapping[str, str]
    ) -> None:
        """Replace this process by a command on a host; returns only by raising."""
        way = entrance(self._hierarchies, self._record(), host, command, user=user, environment=env)
        for descriptor in way.descriptors:
            os.set_inheritable(descriptor, True)
        os.execve(way.command[0], way.command, way.environment)  # noqa: S606 - no shell is wanted

    # --- faults -------------------------------------------------------------------------------

    def cut(self, host: str, direction: Direction = "both") -> None:
        """Drop all packets to the host ("in"), from it ("out"), or both."""
        self._change_link(host, direction, cut=True)

    def loss(self, host: str, fraction: float, direction: Direction = "both") -> None:
        """Lose a fraction (0..1) of the packets to and from a host; 0 ends it."""
        check_loss(fraction)
        self._change_link(host, direction, loss=fraction)

    def delay(self, host: str, seconds: float, direction: Direction = "both") -> None:
        """Delay each packet to and from a host, seconds; 0 ends it.

        Raises:
            LabError: this kernel has no netem; nothing was changed.
        """
        check_delay(seconds)
        self._change_link(host, direction, delay=seconds)

    def rate(self, host: str, rate: float, direction: Direction = "both") -> None:
        """Drop the packets to and from a host beyond a rate, bytes a second; 0 ends it."""
        check_rate(rate)
        self._change_link(host, direction, rate=rate)

    def heal(self, host: str) -> None:
        """End cuts, losses, delays and rates of a host."""
        self._change_link(host, "both", cut=False, loss=0.0, delay=0.0, rate=0.0)

    def kill(self, host: str) -> None:
        """Cut a host's power: all its processes end at once, and send nothing more.

        Its disk keeps what was written; memory, /run and /dev/shm are lost. `boot` ends it.
        """
        from rosrm_lab import making

        with making.explained(self.name), store.lock(self.name):
            record = self._record()
            making.switch_off(self._hierarchies, record, record.plan.host(host).name)
            store.write(record)

    def boot(self, host: str) -> None:
        """Switch a host on again after `kill`; no process runs there yet. Raises `LabError`."""
        from rosrm_lab import making

        with making.explained(self.name), store.lock(self.name):
            record = self._record()
            if self.is_up(host):
                raise LabError(f"host {host} of lab {self.name!r} is up already")
            making.switch_on(self._hierarchies, record, host)
            store.write(record)

    # --- helpers ------------------------------------------------------------------------------

    @property
    def _hierarchies(self) -> list[groups.Hierarchy]:
        if self._known is None:
            self._known = groups.find_hierarchies()
        return self._known

    def _record(self) -> LabRecord:
        record = store.read(self.name)
        if record is None:
            others = ", ".join(sorted(store.labs())) or "none"
            raise LabError(
                f"there is no lab {self.name!r} (labs: {others}); `rosrm lab up` makes one"
            )
        if not record.complete:
            raise LabError(
                f"lab {self.name!r} is incomplete: `rosrm lab up` makes it again, "
                "`rosrm lab down` removes its parts"
            )
        if record.boot != boot_id():
            raise LabError(
                f"lab {self.name!r} did not survive the restart of this machine: `rosrm lab up` "
                "makes it again, `rosrm lab down` removes the rest of it"
            )
        return record

    def _change_link(self, host: str, direction: Direction, **values: Any) -> None:
        from rosrm_lab import making

        with making.explained(self.name), store.lock(self.name):
            record = self._record()
            before = record.links[record.plan.host(host).name]
            after = before.changed(direction, **values)
            making.change_link(record, host, before, after)
            store.write(record)


def _undo(first: BaseException, remove: Callable[[], object]) -> None:
    """Remove a lab that could not be made.

    Raises:
        LabError: it cannot be removed either; the text has both reasons.
    """
    try:
        _to_the_end(remove)
    except (LabError, OSError, subprocess.SubprocessError) as fault:
        raise LabError(
            f"{str(first) or type(first).__name__}; then the lab could not be removed: {fault}. "
            "`rosrm lab down` tries again"
        ) from first


def _to_the_end(remove: Callable[[], object]) -> None:
    """Remove a lab completely; a signal's exception is raised again when nothing is left."""
    try:
        remove()
    except BaseException:  # such as KeyboardInterrupt by the signal
        remove()
        raise


def all_labs() -> Iterator[Lab]:
    """Yield every lab with remains on this machine, killed attempts too."""
    from rosrm_lab import network

    found = store.labs() | groups.labs(groups.find_hierarchies())
    prefix = switch_namespace("")
    found |= {
        name.removeprefix(prefix).partition(":")[0]
        for name in network.existing()
        if name.startswith(prefix)
    }
    for name in sorted(found):
        try:
            yield Lab(name)
        except ConfigError:  # a folder that is not of a lab
            continue
