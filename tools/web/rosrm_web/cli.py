"""The command `rosrm web`."""

# What only a running gateway needs is imported when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import logging
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rosrm.cli.commands.logs import Archive, open_archive
from rosrm.cli.connection import ros_settings
from rosrm.cli.options import CommonOptions, Domain
from rosrm.cli.output.plain import echo
from rosrm_web.settings import DEFAULT_LISTEN, checked

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.client.retrying import Notify
    from rosrm.model.ros_settings import RosSettings

#: Seconds for one search for the master.
_SEARCH = 2.0


def web(  # noqa: PLR0913, PLR0917 - an argument for each option
    ctx: typer.Context,
    listen: Annotated[
        str,
        typer.Option(
            "--listen", metavar="ADDRESS[:PORT]", help="IP address, e.g. 0.0.0.0 or [::1]:8291."
        ),
    ] = DEFAULT_LISTEN,
    certificate: Annotated[
        Path | None,
        typer.Option(
            "--certificate", metavar="FILE", help="PEM file with the certificate chain, for HTTPS."
        ),
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option(
            "--key", metavar="FILE", help="PEM file with the private key, with mode 0600."
        ),
    ] = None,
    tokens: Annotated[
        Path | None,
        typer.Option(
            "--tokens",
            metavar="FILE",
            help="File with lines `ROLE NAME TOKEN`; then every request needs a token.",
        ),
    ] = None,
    allow_actions: Annotated[
        bool, typer.Option("--allow-actions", help="Let operators act; needs --tokens.")
    ] = False,
    plain_http: Annotated[
        bool,
        typer.Option(
            "--plain-http",
            help="Allow HTTP without TLS on an address that other machines can reach.",
        ),
    ] = False,
    names: Annotated[
        list[str] | None,
        typer.Option("--name", metavar="NAME", help="DNS name of this machine; repeatable."),
    ] = None,
    archive: Archive = None,
    domain: Domain = None,
) -> None:
    """Serve a page about the cluster, and its state as JSON, until Ctrl-C.

    The gateway is a client of the master, on 127.0.0.1:8290, and by default only reads.
    """
    from rosrm_web.gateway import Gateway
    from rosrm_web.serving import open_socket, serve, url_of

    settings = checked(
        listen, certificate=certificate, key=key, plain_http=plain_http, names=names or (),
        tokens=tokens, allow_actions=allow_actions,
    )  # fmt: skip
    _log_to_stderr()
    cluster = ctx.obj.cluster if isinstance(ctx.obj, CommonOptions) else None
    open_archive(archive)  # refuses a directory without an archive
    gateway = Gateway(partial(_connect, ros_settings(ctx, domain), cluster), archive)
    with open_socket(settings) as listener:
        rights = "operators may act" if settings.is_acting else "it only reads"
        said = f"rosrm web: {url_of(listener, settings)}; {rights}"
        serve(gateway, settings, listener, lambda: echo(said))


def _connect(ros: RosSettings, cluster: Path | None, notify: Notify) -> Client:
    from rosrm.client.client import Client

    return Client(ros=ros, cluster=cluster, timeout=_SEARCH, notify=notify)


def _log_to_stderr() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.getLogger("rosrm.web").setLevel(logging.INFO)
    # The end of requests that follow changes is no error.
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
