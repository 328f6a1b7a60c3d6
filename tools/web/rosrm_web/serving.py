"""The process of the gateway: its socket, its signals, its end."""

from __future__ import annotations

import asyncio
import errno
import logging
import math
import resource
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

import uvicorn

from rosrm import clocks
from rosrm.errors import ConfigError, NoMaster, Refused
from rosrm.runtime.dispositions import handle
from rosrm.shortage import SHORTAGE
from rosrm.wording import reason_of
from rosrm_web.access import Access
from rosrm_web.app import create_app
from rosrm_web.connections import MOST_CONNECTIONS, Connection
from rosrm_web.guard import Guard
from rosrm_web.sessions import Sessions
from rosrm_web.tasks import serve_always

if TYPE_CHECKING:
    from rosrm_web.gateway import Gateway
    from rosrm_web.guard import App
    from rosrm_web.settings import Settings

#: Connections that are accepted in one turn of the loop, and that the kernel keeps until then.
_BACKLOG: Final = 64
#: Open files that the gateway needs at most: connections, and ROS.
_DESCRIPTORS: Final = 8192
#: Errors of a process or machine without room for another open file.
_NO_ROOM: Final = SHORTAGE | {errno.ENOBUFS}
#: Least seconds between two log lines about them.
_LOGGED_EVERY: Final = 10.0

_log = logging.getLogger("rosrm.web")

#: Bytes of the request line and the headers.
_LARGEST_HEAD: Final = 16 * 1024
#: Bytes of a message of the page in the browser.
_LARGEST_MESSAGE: Final = 256 * 1024
#: Milliseconds after which the kernel ends a connection whose client takes no data.
_SLOWEST_READER: Final = 20_000


def open_socket(settings: Settings) -> socket.socket:
    """Return a listening socket.

    Raises:
        ConfigError: the address is not one of this machine, or the port is in use.
    """
    family = socket.AF_INET6 if ":" in settings.address else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Accepted connections have it, too.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _SLOWEST_READER)
        listener.bind((settings.address, settings.port))
        listener.listen(MOST_CONNECTIONS)
    except OSError as error:
        listener.close()
        where = f"{settings.address} port {settings.port}"
        if error.errno == errno.EADDRINUSE:
            raise ConfigError(
                f"--listen: {where} is in use, perhaps by another `rosrm web`; give another port, "
                f"such as --listen {settings.address}:{(settings.port + 1) % 65536}"
            ) from None
        raise ConfigError(f"--listen: {where} cannot be used: {reason_of(error)}") from None
    return listener


def url_of(listener: socket.socket, settings: Settings) -> str:
    """Return the URL of the gateway."""
    address, port = listener.getsockname()[:2]
    shown = f"[{address}]" if ":" in address else address
    return f"{settings.scheme}://{shown}:{port}"


def serve(
    gateway: Gateway, settings: Settings, listener: socket.socket, ready: Callable[[], None]
) -> None:
    """Answer requests until SIGINT or SIGTERM.

    Args:
        gateway: source of the answers.
        settings: of the gateway.
        listener: listening socket.
        ready: called once when the gateway answers requests.
    """
    access = Access(settings.users, settings.tokens)
    sessions = Sessions(access)
    app = create_app(gateway, settings, access, sessions)
    server = http_server(Guard(app, settings, access, sessions), settings)
    allow_descriptors()
    asyncio.run(_serve(gateway, access, server, listener, ready))


def allow_descriptors() -> None:
    """Let this process have more open files than its connections take.

    Otherwise a flood of connections would leave none for the client of the master.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class AcceptErrors:
    """Handler of the loop's exceptions: a flood of connections must not flood the log.

    asyncio reports each connection that cannot be accepted with a traceback, thousands a second.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = clocks.boot_time) -> None:
        self._clock = clock
        self._logged, self._more = -math.inf, 0

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an exception; those of accepting at most every `_LOGGED_EVERY` seconds."""
        error = context.get("exception")
        if not isinstance(error, OSError) or error.errno not in _NO_ROOM:
            loop.default_exception_handler(context)
            return
        now = self._clock()
        if now - self._logged < _LOGGED_EVERY:
            self._more += 1
            return
        more = f"; {self._more} more since the last line" if self._more else ""
        _log.error("connections: cannot accept one: %s%s", reason_of(error), more)
        self._logged, self._more = now, 0


class _Server(uvicorn.Server):
    """A server that ends by `_serve` alone: its own handlers take signals that it has to ignore."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def http_server(app: App, settings: Settings) -> uvicorn.Server:
    """Return a server for an application."""
    protocol = partial(Connection, tls=settings.tls())
    return _Server(uvicorn.Config(
        app, loop="asyncio", http=cast("type[asyncio.Protocol]", protocol), lifespan="on",
        log_config=None, access_log=False, server_header=False, proxy_headers=False,
        h11_max_incomplete_event_size=_LARGEST_HEAD, timeout_graceful_shutdown=1,
        backlog=_BACKLOG,
        ws_max_size=_LARGEST_MESSAGE,
    ))  # fmt: skip


async def _serve(
    gateway: Gateway, access: Access, server: uvicorn.Server, listener: socket.socket,
    ready: Callable[[], None],
) -> None:  # fmt: skip
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(AcceptErrors())

    def stop(*_: object) -> None:
        server.should_exit = True

    handle((signal.SIGINT, signal.SIGTERM), stop)
    with suppress(NoMaster, Refused):  # all other errors will not pass
        await gateway.watcher.look()
    tasks = [
        serve_always(gateway.watcher.run, "watcher"), serve_always(access.follow_file, "tokens"),
    ]  # fmt: skip
    ready()
    await server.serve(sockets=[listener])
    for task in tasks:
        task.cancel()
    gateway.close()
