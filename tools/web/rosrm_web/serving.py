"""The process of the gateway: its socket, its signals, its end."""

from __future__ import annotations

import asyncio
import errno
import signal
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import uvicorn

from rosrm.errors import ConfigError, NoMaster, Refused
from rosrm_web.app import create_app
from rosrm_web.guard import Guard

if TYPE_CHECKING:
    from rosrm_web.gateway import Gateway
    from rosrm_web.settings import Settings

#: Highest number of connections at the same time; further ones are refused.
MOST_CONNECTIONS: Final = 128
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
        raise ConfigError(f"--listen: {where} cannot be used: {error.strerror}") from None
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
    config = uvicorn.Config(
        Guard(create_app(gateway, settings), settings), loop="asyncio", http="h11", lifespan="on",
        log_config=None, access_log=False, server_header=False, proxy_headers=False,
        limit_concurrency=MOST_CONNECTIONS, h11_max_incomplete_event_size=_LARGEST_HEAD,
        timeout_graceful_shutdown=1, ws_max_size=_LARGEST_MESSAGE,
        ssl_certfile=settings.certificate, ssl_keyfile=settings.key,
    )  # fmt: skip
    asyncio.run(_serve(gateway, uvicorn.Server(config), listener, ready))


async def _serve(
    gateway: Gateway, server: uvicorn.Server, listener: socket.socket, ready: Callable[[], None]
) -> None:
    loop = asyncio.get_running_loop()

    def stop() -> None:
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)
    with suppress(NoMaster, Refused):  # all other errors will not pass
        await gateway.watcher.look()
    watching = asyncio.create_task(gateway.watcher.run())
    ready()
    # uvicorn raises the signal again at its end: `stop` takes it.
    await server.serve(sockets=[listener])
    watching.cancel()
    gateway.close()
