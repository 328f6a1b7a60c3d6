"""Commands `rosrm service`: units of systemd that run the master or the slave of this machine."""

# Each command imports its modules when it runs, so that `rosrm --help` is quick.
# ruff: noqa: PLC0415

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from rosrm.cli.options import CommonOptions, Domain
from rosrm.cli.output.plain import echo
from rosrm.cli.systemd_unit import MARK, Part, needed_variables, unit_name, unit_text, wanted_by
from rosrm.errors import ConfigError, RosrmError
from rosrm.wording import reason_of

service = typer.Typer(
    no_args_is_help=True, help="Run the master or the slave as a service of systemd."
)

#: Directory of the units that an administrator adds to the machine.
SYSTEM_UNITS: Final = Path("/etc/systemd/system")
_PART = typer.Argument(
    metavar="PART", help="The part of rosrm that the unit runs.", show_default=False
)
_USER = typer.Option("--user", help="A unit of this user, instead of one of the machine.")


@service.callback()
def _group() -> None:
    """Run the master or the slave as a service of systemd."""


@service.command()
def install(
    ctx: typer.Context,
    part: Annotated[Part, _PART],
    *,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            metavar="FILE",
            help="Its cluster.yaml or host.yaml; default: the default settings.",
        ),
    ] = None,
    of_user: Annotated[bool, _USER] = False,
    run_as: Annotated[
        str,
        typer.Option(
            "--run-as", metavar="NAME",
            help="User that runs a unit of the machine, e.g. robot; default: the user who calls "
            "this command, also by sudo.",
        ),
    ] = "",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the unit; write no file.")
    ] = False,
    domain: Domain = None,
) -> None:  # fmt: skip
    """Write a unit that runs `rosrm master` or `rosrm slave`, and starts it again if it ends.

    The file is checked first. The unit has the variables of ROS and rosrm, and PATH, as they are
    set now. The command starts nothing: it prints the commands of systemd that do.
    """
    from rosrm.runtime.ros_wheels import without_bootstrapper

    if of_user and run_as:
        raise ConfigError("--run-as is for a unit of the machine: leave out --user")
    user = None if of_user else _existing(run_as or os.environ.get("SUDO_USER") or _own_name())
    common = ctx.ensure_object(CommonOptions)
    file = config or (common.cluster if part == "master" else None)
    keeps = _check(part, file)
    command = [*_rosrm(), part, *([] if file is None else ["--config", str(file.absolute())])]
    chosen = common.domain if domain is None else domain
    command += [] if chosen is None else ["--domain", str(chosen)]
    variables = needed_variables(without_bootstrapper(os.environ))
    text = unit_text(part, command, variables, user)
    if dry_run:
        echo(text.rstrip("\n"))
        return
    path = _directory(of_user) / unit_name(part)
    _write(path, text, f"rosrm service install {part}")
    name, systemctl = unit_name(part), _systemctl(of_user)
    echo(f"wrote {path}: {' '.join(command)}, with the variables {', '.join(variables)}")
    echo(f"next: {systemctl} daemon-reload && {systemctl} enable --now {name}")
    if of_user:
        echo("so that the unit also runs while this user is logged out: loginctl enable-linger")
    if not keeps:
        echo("its processes end with the slave; `on_stop: keep` in its file keeps them running")


@service.command()
def remove(
    part: Annotated[Part, _PART],
    of_user: Annotated[bool, _USER] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the path of the unit; remove no file.")
    ] = False,
) -> None:
    """Remove a unit that `rosrm service install` has written, once it is disabled."""
    name, directory, systemctl = unit_name(part), _directory(of_user), _systemctl(of_user)
    path = directory / name
    if not path.exists():
        raise ConfigError(f"there is no {path}")
    _check_mark(path)
    if (directory / f"{wanted_by(of_user)}.wants" / name).is_symlink():
        raise ConfigError(f"{name} is enabled; first run: {systemctl} disable --now {name}")
    if dry_run:
        echo(f"would remove {path}")
        return
    try:
        path.unlink()
    except OSError as error:
        raise RosrmError(f"{path} cannot be removed: {reason_of(error)}") from None
    echo(f"removed {path}; next: {systemctl} daemon-reload")


def _own_name() -> str:
    import pwd

    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        raise ConfigError(f"the user {os.geteuid()} has no name: give --run-as NAME") from None


def _existing(name: str) -> str:
    import pwd

    try:
        pwd.getpwnam(name)
    except KeyError:
        raise ConfigError(f"this machine has no user {name!r}: give --run-as NAME") from None
    return name


def _check(part: Part, file: Path | None) -> bool:
    """Check the file as `rosrm master` and `rosrm slave` do; return True if processes are kept."""
    from rosrm.config.cluster import load_cluster
    from rosrm.config.host import load_host
    from rosrm.extensions.registry import Registry

    if part == "master":
        if file is not None:
            load_cluster(file, Registry.discover())
        return True
    return file is not None and load_host(file, Registry.discover()).on_stop == "keep"


def _rosrm() -> list[str]:
    """Return the words that run this command from any directory."""
    own = shutil.which(sys.argv[0])
    if own is not None and Path(own).name == "rosrm":
        return [str(Path(own).absolute())]
    return [sys.executable, "-m", "rosrm.cli"]


def _directory(of_user: bool) -> Path:
    if not of_user:
        return SYSTEM_UNITS
    base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(base) / "systemd" / "user"


def _systemctl(of_user: bool) -> str:
    return "systemctl --user" if of_user else "sudo systemctl"


def _check_mark(path: Path) -> None:
    if not path.read_text(encoding="utf-8", errors="replace").startswith(MARK):
        raise ConfigError(f"{path} was not written by `rosrm service install`: move it away first")


def _write(path: Path, text: str, command: str) -> None:
    try:
        if path.exists():
            _check_mark(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        how = "" if path.parent != SYSTEM_UNITS else (
            f". Without the rights of root: `{command} ... --dry-run | sudo tee {path}`, or a unit "
            "of this user: --user"
        )  # fmt: skip
        raise RosrmError(f"{path} cannot be written: {reason_of(error)}{how}") from None
