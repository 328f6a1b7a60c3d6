"""The connection to the master: requests and listings; `rosrm.Client` uses it.

A request goes through the socket of a master on this machine, and otherwise, or if no answer comes,
over DDS. rclpy is imported only for DDS.
"""

from __future__ import annotations

import json
import math
import os
import time
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

from rosrm import clocks
from rosrm.errors import NoMaster, Refused, ros_needed
from rosrm.keys.finding import user_security
from rosrm.keys.roles import SecurityMode
from rosrm.keys.security import Member
from rosrm.model.applications import ApplicationRow, ApplyResult, PlannedAction, Target
from rosrm.model.codec import from_plain
from rosrm.model.modes import Mode, ModeRow
from rosrm.model.orders import CHECK_TIMEOUT
from rosrm.model.ros_settings import RosSettings
from rosrm.model.rows import Listing, LogPart
from rosrm.model.values import ProcessSpec
from rosrm.ros import convert, master_socket, names
from rosrm.ros.bounds import check_bounds
from rosrm.ros.control import check_answer, new_envelope
from rosrm.ros.deferred_signals import signals_deferred
from rosrm.ros.introductions import Introduction, introduction_of, introduction_request
from rosrm.ros.sealed import SealedCalls, SealedClient, SealedEndpoints
from rosrm.ros.spec_digests import UNKNOWN_DIGEST, digest_of, positions_from_text
from rosrm.version import PROTOCOL_VERSION, __version__
from rosrm_msgs import srv

if TYPE_CHECKING:
    from typing_extensions import Self

    from rosrm.ros.load_reader import LoadReader
    from rosrm.ros.participant import Participant

#: Seconds between two checks for a service's discovery, for which rclpy has no event.
_LOOK: Final = 0.005
#: Least seconds between two reports to a caller that its request is not answered yet.
_REPORT_EVERY: Final = 0.1
#: Least seconds that a discovered master has for a request.
_REQUEST: Final = 10.0
#: Seconds for a reload, in which master and slaves check their files one after the other.
_RELOAD: Final = 2 * CHECK_TIMEOUT + _REQUEST
#: Seconds after which a request without an answer is sent again.
_AGAIN: Final = 2.0
#: The same for a handshake, which costs the master nothing.
_GREET_AGAIN: Final = 0.5
#: Epoch in an answer that does not name the master's run.
_UNKNOWN_EPOCH: Final = 0
#: Tickets that are kept until expired ones are removed.
_MOST_INTRODUCTIONS: Final = 1000
#: Advice about a master that was discovered and has not answered.
_IGNORED: Final = (
    "A master was found there, and did not answer: it has just ended, or this key is not valid any "
    "more, because the cluster's secret was replaced (`rosrm key rotate`, a master with another "
    "secret) or the key was revoked."
)
#: Name of the master in messages.
_MASTER: Final = "the master"


#: Takes the seconds for which a request has waited; an exception that it raises ends the wait.
OnWait = Callable[[float], None]


def _spin(participant: Participant, timeout: float) -> None:
    """Handle incoming messages for at most `timeout` seconds, and then the signals that arrived."""
    with signals_deferred():
        participant.spin(timeout)


def wait_for_service(
    participant: Participant, client: Any, deadline: float,
    on_look: Callable[[], None] = lambda: None,
) -> bool:  # fmt: skip
    """Return True if a service is discovered before `deadline` (monotonic seconds)."""
    while not client.service_is_ready():
        if clocks.boot_time() >= deadline:
            return False
        on_look()
        _spin(participant, _LOOK)
    return True


def wait_until(
    participant: Participant, done: Callable[[], bool], deadline: float, look: float = 0.1
) -> bool:
    """Return True if `done` becomes true before `deadline` (monotonic seconds).

    `look`: most seconds between two calls of `done`, which each message calls as well.
    """
    while not done():
        left = deadline - clocks.boot_time()
        if left <= 0.0:
            return False
        _spin(participant, min(left, look))
    return True


@dataclass(slots=True)
class _Answers:
    """The first answer to a request, and when and how many times the request was sent."""

    on_wait: OnWait | None = None
    first: tuple[Any, ...] = ()
    sent: int = 0
    began: float = field(default_factory=clocks.boot_time)
    reported: float = -math.inf

    def take(self, future: Any) -> None:
        self.first = self.first or (future.result(),)

    def wait(self) -> None:
        """Call `on_wait` with the seconds since the request, at most every 0.1 s."""
        now = clocks.boot_time()
        if self.on_wait is not None and now - self.reported >= _REPORT_EVERY:
            self.reported = now
            self.on_wait(now - self.began)

    @property
    def answer(self) -> Any:
        """The first answer; None: there is none."""
        return self.first[0] if self.first else None


def _apply_result(answer: Any) -> ApplyResult:
    actions = from_plain(tuple[PlannedAction, ...], json.loads(answer.actions))
    return ApplyResult(str(answer.answer.message), actions)


def is_unsure(answer: Any, epoch: int) -> bool:
    """Return True if a refused repetition may have been carried out the first time.

    Args:
        answer: to the repeated request. If it comes from another run of the master, its "in use
            already" may be an effect of the first request.
        epoch: of the run that got the first request.
    """
    if answer.accepted:
        return False
    return answer.code == "stale" or answer.epoch not in (_UNKNOWN_EPOCH, epoch)


def _ask_until_answered(
    participant: Participant, client: Any, request: Any, deadline: float, again: float,
    *, servers: Callable[[], int] = int, look: float = 0.1, answers: _Answers | None = None,
) -> _Answers:  # fmt: skip
    """Repeat a request until `deadline`; return the first answer.

    `servers` returns the number of discovered servers; another number repeats the request at once.
    `look`: most seconds between two calls of `answers.wait`. `answers`: those of a request that may
    have been sent through the socket before.

    A server sends no answer before it has discovered the client's reader, and a new client's
    request may arrive earlier.
    """
    answers = answers or _Answers()
    known = 0

    def ended() -> bool:
        if not answers.first:
            answers.wait()
        return bool(answers.first) or servers() != known

    while not answers.first:
        now = clocks.boot_time()
        if now >= deadline:
            return answers
        known = servers()
        answers.sent += 1
        with signals_deferred():
            client.call_async(request).add_done_callback(participant.counted(answers.take))
        wait_until(participant, ended, min(deadline, now + again), look)
    return answers


def _about_security(security: str) -> tuple[str, str]:
    """Return the security of this side, and how to check that the master has the same."""
    if security == "none":
        return "security: none", "A master with `security: keys` answers only clients with a key"
    return security, (
        "`rosrm key check` shows this user's keys, and `rosrm key list` on the machine of the "
        "master the valid ones"
    )


def _to_check(settings: RosSettings) -> str:
    """Return a question that tells the user where to look when no master answers."""
    server = {**os.environ, **settings.environment()}.get("ROS_DISCOVERY_SERVER", "")
    master = "`rosrm master` running there, with the same domain"
    if server:
        return f"Is the discovery server at {server} running, and {master} and server?"
    return f"Is {master}?"


class MasterClient:
    """A connection to the master; a context manager.

    Use `connect`. Every request raises `Refused` with the master's message when the master refuses
    it, and `NoMaster` when no answer comes in time.
    """

    def __init__(
        self, settings: RosSettings, security: Member, name: str, timeout: float,
        joined: Participant | None,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._security = security
        self._socket = master_socket.address(settings, security)
        self._joined = joined
        self._made_endpoints: SealedEndpoints[Member] | None = None
        self._master = srv.Handshake.Response()
        self._last_contact = -math.inf
        self._timeout = timeout
        self._names = names.Names(settings.namespace)
        self._sender = f"client {name}"
        self._clients: dict[str, SealedClient] = {}
        self._log_clients: dict[str, SealedClient] = {}
        self._introductions: dict[tuple[str, str], Introduction] = {}
        self._load: LoadReader | None = None

    @classmethod
    def connect(
        cls, settings: RosSettings, *, name: str, timeout: float = 3.0,
        security: SecurityMode = "keys", joined: Participant | None = None,
        begun: float | None = None,
    ) -> MasterClient:  # fmt: skip
        """Find the master and connect.

        Args:
            settings: for joining ROS.
            name: of this client, for the master's messages.
            timeout: seconds for finding the master; a request has the same time, at least 10 s.
            security: "keys" or "none", as the master's.
            joined: an existing participant, which the client then owns.
            begun: start of the user's wait (monotonic seconds), for the message; None: now.

        Raises:
            ConfigError: a key file is invalid, or others can read it.
            NoMaster: none answered, or this user has no key.
            Refused: the master has another version.
        """
        begun = clocks.boot_time() if begun is None else begun
        settings.check()
        try:
            member = user_security(security, timeout)
        except BaseException:  # otherwise an interrupt leaves an open participant
            if joined is not None:
                joined.close()
            raise
        client = cls(settings, member, name, max(timeout, _REQUEST), joined)
        try:
            client._greet(timeout, begun)
        except BaseException:  # otherwise an interrupt leaves an open participant
            client.close()
            raise
        return client

    def _greet(self, timeout: float, begun: float) -> None:
        """Find the master; raise `NoMaster` or `Refused`."""
        hello = self._shake_hands(clocks.boot_time() + timeout)
        settings = self._settings
        if hello is None:
            security, advice = _about_security(self._security.described)
            greeted = self._clients.get(self._names(names.HANDSHAKE))
            if greeted is not None and greeted.service_is_ready():
                advice = f"{_IGNORED} {advice}"
            raise NoMaster(
                f"no master answered within {clocks.boot_time() - begun:.1f} s "
                f"({settings.describe()}, namespace {settings.namespace}, {security}). "
                f"{_to_check(settings)} {advice}"
            )
        if not hello.accepted:
            raise Refused(hello.message, "version")

    def _shake_hands(self, deadline: float) -> srv.Handshake.Response | None:
        """Return the master's description of itself; None: no answer before the deadline."""
        role, _, name = self._sender.partition(" ")
        request = srv.Handshake.Request(
            protocol_version=PROTOCOL_VERSION, software_version=__version__, role=role, name=name
        )
        hello = self._ask_master(
            srv.Handshake, names.HANDSHAKE, request, deadline, _GREET_AGAIN
        ).answer
        if hello is not None:
            self._master, self._last_contact = hello, clocks.boot_time()
        return hello

    @property
    def _endpoints(self) -> SealedEndpoints[Member]:
        """Endpoints over DDS, created on first use, because that imports rclpy."""
        if self._made_endpoints is None:
            with ros_needed():
                from rosrm.ros.participant import Participant  # noqa: PLC0415 - see above

            self._joined = self._joined or Participant(self._settings, names.client_node())
            self._made_endpoints = SealedEndpoints(self._joined, self._security)
        return self._made_endpoints

    @property
    def _participant(self) -> Participant:
        return self._endpoints.participant

    @property
    def master_pid(self) -> int:
        """Return the pid of the master, on the master's machine."""
        return int(self._master.pid)

    # --- requests ------------------------------------------------------------------------

    def submit(self, specs: Sequence[ProcessSpec]) -> str:
        """Queue processes, all or none; return the master's message."""
        return self._ask(
            srv.Submit, names.SUBMIT, processes=[convert.spec_to_msg(spec) for spec in specs]
        )

    def apply(self, targets: Sequence[Target], *, plan_only: bool = False) -> ApplyResult:
        """Make applications as desired, or return the plan of that."""
        digests = [[digest_of(spec) for spec in one.specs] for one in targets]
        headings = [replace(one, specs=()) for one in targets]

        def ask(sent: Iterable[Iterable[int] | None]) -> ApplyResult:
            messages = [
                convert.target_to_msg(*one) for one in zip(targets, digests, sent, strict=True)
            ]
            answer = self._request(srv.Apply, names.APPLY, targets=messages, plan_only=plan_only)
            return replace(_apply_result(answer), work=digest_of([headings, digests]))

        lacking: Sequence[Iterable[int]] = [()] * len(targets)
        for _ in range(2):
            try:
                return ask(lacking)
            except Refused as refusal:
                if refusal.code != UNKNOWN_DIGEST:
                    raise
                lacking = positions_from_text(str(refusal), map(len, digests))
        return ask([None] * len(targets))  # requests of others have replaced the specs

    def load_modes(self, modes: Sequence[Mode]) -> str:
        """Replace the modes of the cluster, all or none; return the master's message."""
        return self._ask(
            srv.LoadModes, names.LOAD_MODES, modes=[convert.mode_to_msg(one) for one in modes]
        )

    def switch_mode(self, mode: str, *, plan_only: bool = False) -> ApplyResult:
        """Switch to a mode, or return the plan of that."""
        answer = self._request(srv.SwitchMode, names.SWITCH_MODE, mode=mode, plan_only=plan_only)
        return _apply_result(answer)

    def store_artifact(self, digest: str, size: int, offset: int, data: bytes = b"") -> int:
        """Send a part of an artifact, and return the offset of the part that the master expects.

        Without data the request only asks for this offset, and makes room for the artifact.

        Args:
            digest: SHA-256 of the archive in hexadecimal digits.
            size: bytes of the archive; as a result: all of them have arrived.
            offset: of the first byte of the part.
        """
        request = srv.StoreArtifact.Request(
            protocol_version=PROTOCOL_VERSION, digest=digest, size=size, offset=offset,
            data=array("B", data),
        )  # fmt: skip
        answer = self._call(srv.StoreArtifact, names.STORE_ARTIFACT, request)
        return int(answer.next_offset)

    def load(self) -> Mapping[str, float]:
        """Return figures of the master's newest load; the first call begins to follow them."""
        if self._load is None:
            from rosrm.ros.load_reader import LoadReader  # noqa: PLC0415 - imports rclpy

            self._load = LoadReader(self._endpoints, self._names(names.MASTER_LOAD))
        return self._load.newest()

    def spin(self, timeout: float) -> None:
        """Handle incoming messages for at most `timeout` seconds."""
        if self._joined is None:
            time.sleep(timeout)  # nothing arrives without a request
        else:
            _spin(self._joined, timeout)

    def cancel(self, processes: Sequence[str], *, force: bool = False) -> str:
        """Remove processes from the queue, or stop them; with `force` by SIGKILL at once."""
        service = names.KILL if force else names.CANCEL
        return self._ask(srv.Cancel, service, processes=list(processes))

    def restart(self, processes: Sequence[str]) -> str:
        """Restart processes where they run; queue ended ones again."""
        return self._ask(srv.Restart, names.RESTART, processes=list(processes))

    def migrate(self, name: str, host: str | None = None) -> str:
        """Begin the migration of a process; without a host the core chooses one."""
        return self._ask(srv.Migrate, names.MIGRATE, process=name, host=host or "")

    def checkpoint(self, name: str) -> str:
        """Begin to dump a process into a checkpoint image on its host; the process ends."""
        return self._ask(srv.Checkpoint, names.CHECKPOINT, process=name)

    def restore(self, name: str) -> str:
        """Begin to restore a process from its checkpoint image, on the host that holds it."""
        return self._ask(srv.Restore, names.RESTORE, process=name)

    def set_host_state(self, host: str, action: str) -> str:
        """Cordon, uncordon or drain a host."""
        return self._ask(srv.SetHostState, names.SET_HOST_STATE, host=host, action=action)

    def prune(self, processes: Sequence[str] = (), hosts: Sequence[str] = ()) -> str:
        """Remove ended processes and departed hosts from the listings; without names: all."""
        return self._ask(srv.Prune, names.PRUNE, processes=list(processes), hosts=list(hosts))

    def rebalance(self, *, plan_only: bool = False) -> str:
        """Begin one round of moves that even out the load of the hosts, or return its plan."""
        return self._ask(srv.Rebalance, names.REBALANCE, plan_only=plan_only)

    def reload(self) -> str:
        """Let master and slaves read their files again; return a line for each."""
        return self._ask(srv.Reload, names.RELOAD, patience=_RELOAD)

    # --- listings and logs ---------------------------------------------------------------

    def list(  # noqa: PLR0913 - the parts of one listing
        self, *, hosts: bool = False, processes: bool = False,
        plugins: bool | Literal["failing"] = False, applications: bool = False,
        modes: bool = False, events: bool = False, process: str = "", host: str = "",
        after: int = 0, newest: int = 0, on_wait: OnWait | None = None,
    ) -> Listing:  # fmt: skip
        """Return the requested listings; `plugins="failing"` limits plugins to failing ones.

        The arguments from `process` to `newest` narrow the events. `on_wait` is called about every
        0.1 s while the master does not answer.
        """
        request = srv.List.Request(
            protocol_version=PROTOCOL_VERSION, hosts=hosts, processes=processes,
            plugins=bool(plugins), failing=plugins == "failing", events=events,
            applications=applications, modes=modes, process=process, host=host,
            after_sequence=after, max_events=newest,
        )  # fmt: skip
        answer = self._call(srv.List, names.LIST, request, on_wait=on_wait)
        return Listing(
            master=answer.master, uptime=answer.uptime, last_sequence=answer.last_sequence,
            trouble=answer.trouble, security=answer.security, strangers=answer.strangers,
            hosts=[convert.host_row_from_msg(row) for row in answer.host_list],
            processes=[convert.process_row_from_msg(row) for row in answer.process_list],
            plugins=[convert.plugin_row_from_msg(row) for row in answer.plugin_list],
            applications=from_plain(
                tuple[ApplicationRow, ...], json.loads(answer.application_list)
            ),
            modes=from_plain(tuple[ModeRow, ...], json.loads(answer.mode_list)),
            events=[convert.event_from_msg(row) for row in answer.event_list],
        )  # fmt: skip

    def explain(self, name: str) -> Mapping[str, Any]:
        """Return the reasons for a process's placement, or for its wait."""
        request = srv.Explain.Request(protocol_version=PROTOCOL_VERSION, process=name)
        answer = self._call(srv.Explain, names.EXPLAIN, request)
        story: Mapping[str, Any] = json.loads(answer.explanation)
        return story

    def read_log(
        self, host: str, process: str, number: int = 0, offset: int = 0, max_bytes: int = 0, *,
        tail: int = 0, since: float = 0.0,
    ) -> LogPart:  # fmt: skip
        """Read a part of a log from the slave that holds it.

        Args:
            number: of the instance; 0: the newest on that host.
            offset: of the first byte.
            max_bytes: 0: as many as one answer holds.
            tail: start this many lines before the end instead; 0: at `offset`.
            since: start with output written at this unix time or later; 0: at `offset`.
        """
        request = srv.ReadLog.Request(
            protocol_version=PROTOCOL_VERSION, process=process, number=number, offset=offset,
            max_bytes=max_bytes, tail=tail, since=since,
        )  # fmt: skip
        answer = self._call_slave(host, process, request)
        marks = zip(answer.mark_times, answer.mark_offsets, answer.mark_pids, strict=True)
        return LogPart(
            answer.number, tuple(answer.numbers), bytes(answer.content), answer.offset,
            answer.next_offset, answer.ended, tuple(marks),
        )  # fmt: skip

    # --- transport -----------------------------------------------------------------------

    def _envelope(self) -> Any:
        """Return a request's envelope; renew the beat before the master would reject it as old."""
        now = clocks.boot_time()
        if now - self._last_contact > 1.0 and self._shake_hands(now + self._timeout) is None:
            raise self._silent(_MASTER)
        return new_envelope(self._sender, self._master.beat, self._master.epoch)

    def _ask(self, kind: Any, name: str, *, patience: float = 0.0, **fields: Any) -> str:
        """Send a request that acts, and return the master's message; see `_request`."""
        return str(self._request(kind, name, patience=patience, **fields).answer.message)

    def _request(self, kind: Any, name: str, *, patience: float = 0.0, **fields: Any) -> Any:
        """Send a request that acts, and return the answer.

        `patience`: seconds for the answer, if more than for other requests.
        """
        request = kind.Request(**fields)
        for is_repeated in (False, True):
            request.envelope = self._envelope()
            try:
                return self._call(kind, name, request, patience)
            except Refused as refusal:
                if is_repeated or refusal.code != "stale":
                    raise
                self._last_contact = -math.inf  # another run of the master answered
        raise AssertionError("the second request is answered, or refused")

    def _silent(self, who: str, trouble: str = "", unknown: str = "") -> NoMaster:
        """Return the error for a part that does not answer.

        Args:
            trouble: its reason, if that is known.
            unknown: a sentence on the fate of the request.
        """
        settings = self._settings
        check = _to_check(settings) if who == _MASTER else "Is `rosrm slave` running there?"
        return NoMaster(
            f"{who} did not answer within {self._timeout:g} s ({settings.describe()})"
            f"{trouble}{unknown}{'' if trouble else f'. {check}'}"
        )

    def _ask_master(
        self, kind: Any, name: str, request: Any, deadline: float, again: float,
        on_wait: OnWait | None = None,
    ) -> _Answers:  # fmt: skip
        """Send a request through the socket of the master, then over DDS until it is answered."""
        answers = _Answers(on_wait)
        until = answers.began + min(again, (deadline - answers.began) / 2)  # the rest is for DDS
        self._ask_socket(kind, self._names(name), request, until, answers)
        if answers.first:
            return answers
        client = self._client(kind, name)
        if not wait_for_service(self._participant, client, deadline, answers.wait):
            return answers
        # The services of a killed master look ready until its DDS lease ends, so a handshake is
        # repeated when DDS discovers another server.
        more: Any = {"servers": client.servers, "look": _LOOK} if kind is srv.Handshake else {}
        return _ask_until_answered(
            self._participant, client, request, deadline, again, answers=answers, **more
        )

    def _ask_socket(
        self, kind: Any, service: str, request: Any, until: float, answers: _Answers
    ) -> None:
        """Send a request through the socket of the master, if there is one."""
        connection = master_socket.connect(self._socket)
        if connection is None:
            return
        with connection:
            master = self._security.master
            calls = SealedCalls(kind, service, first_contact=True)
            sent = calls.seal(master, request)
            content = master_socket.request_of(service, sent)
            if len(content) > master_socket.MOST_REQUEST:
                return
            answers.sent = 1
            answer = master_socket.ask(connection, content, until, answers.on_wait)
        response = calls.open(master, sent, answer)
        if response is not None:
            answers.first = (response,)
        elif clocks.boot_time() >= until:
            self._socket = ""  # DDS from now on, so that no later request waits for this socket
        if self._load is not None:
            _spin(self._participant, 0.0)  # takes the load that has arrived

    def _client(self, kind: Any, name: str) -> SealedClient:
        """Return the client of a service over DDS, which takes 0.1 s to discover a new one."""
        path = self._names(name)
        if path not in self._clients:
            self._clients[path] = self._endpoints.client(
                kind, path, self._security.master, first_contact=True
            )
        return self._clients[path]

    def _call_slave(self, host: str, process: str, request: srv.ReadLog.Request) -> Any:
        """Send a request for a log to a slave, with a ticket."""
        who = f"the slave of {host}"
        for is_repeated in (False, True):
            client = self._introduced(host, process)
            if not wait_for_service(self._participant, client, clocks.boot_time() + self._timeout):
                raise self._silent(who)
            ask = partial(_ask_until_answered, self._participant, client, request, again=_AGAIN)
            try:
                return self._answered(ask, srv.ReadLog, request, who)
            except Refused as refusal:
                if is_repeated or refusal.code != "stale":
                    raise
                del self._introductions[host, process]  # of the former run: the slave has restarted
        raise AssertionError("the second request is answered, or refused")

    def _introduced(self, host: str, process: str) -> SealedClient:
        """Return the client of a slave, with a valid ticket for the logs of a process."""
        known = self._introductions.get((host, process))
        if known is None or clocks.boot_time() >= known.until:
            known = self._introductions[host, process] = self._introduce(host, process)
        client = self._log_clients.get(host)
        if client is None:
            path = self._names.of_host(host, names.READ_LOG)
            client = self._log_clients[host] = self._endpoints.client(
                srv.ReadLog, path, known.slave
            )
        client.peer = known.slave
        return client

    def _introduce(self, host: str, process: str) -> Introduction:
        now = clocks.boot_time()
        if len(self._introductions) >= _MOST_INTRODUCTIONS:
            known = self._introductions.items()
            self._introductions = {at: one for at, one in known if now < one.until}
        request = introduction_request(host, names.READ_LOG, process)
        try:
            response = self._call(srv.Introduce, names.INTRODUCE, request)
        except Refused as refusal:
            if refusal.code != "silent":
                raise
            raise NoMaster(f"{refusal}. Is `rosrm slave` running there?") from refusal
        return introduction_of(response, self._security, now)

    def _call(
        self, kind: Any, name: str, request: Any, patience: float = 0.0,
        on_wait: OnWait | None = None,
    ) -> Any:  # fmt: skip
        """Send a request to the master until it is answered."""
        ask = partial(self._ask_master, kind, name, request, again=_AGAIN, on_wait=on_wait)
        try:
            return self._answered(ask, kind, request, _MASTER, patience)
        except Refused as refusal:
            if refusal.code != "stale" or hasattr(request, "envelope"):
                raise
            # Another run of the master answered, and its run is stored now. A read-only request may
            # be repeated.
            return self._answered(ask, kind, request, _MASTER)

    def _answered(
        self, ask: Callable[..., _Answers], kind: Any, request: Any, who: str,
        patience: float = 0.0,
    ) -> Any:  # fmt: skip
        """Send a request until an answer comes; the receiver repeats a lost answer.

        `ask` sends it until the `deadline` in its argument.

        Every request may be repeated: it only reads, or carries an id by which it is recognised.
        One that exceeds its bounds is not sent: `Refused` names the field.
        """
        check_bounds(request)
        deadline = clocks.boot_time() + max(self._timeout, patience)
        answers = ask(deadline=deadline)
        response = answers.answer
        acts = hasattr(request, "envelope")  # read-only requests have none
        if response is None and not answers.sent:
            raise self._silent(who)
        if response is None:
            unknown = ". It is not known whether it was done" if acts else ""
            raise self._silent(who, self._trouble(kind), unknown)
        if acts and answers.sent > 1 and is_unsure(response.answer, self._master.epoch):
            raise Refused(
                f"{who} was silent when it was asked first, and has forgotten it since: it is not "
                f"known whether it was done. Look at `rosrm ps`, and ask again if need be",
                "unsure",
            )
        check_answer(response.answer, who)
        return response

    def _trouble(self, kind: Any) -> str:
        """Return the master's reason for an open request, if it has one: it may still act later."""
        if kind is srv.List:
            return ""
        request = srv.List.Request(protocol_version=PROTOCOL_VERSION)
        deadline = clocks.boot_time() + _AGAIN
        answer = self._ask_master(srv.List, names.LIST, request, deadline, _GREET_AGAIN).answer
        trouble = answer.trouble if answer is not None else ""
        return f": {trouble}. The request may still be executed then" if trouble else ""

    def close(self) -> None:
        """Leave ROS."""
        if self._joined is not None:
            self._joined.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
