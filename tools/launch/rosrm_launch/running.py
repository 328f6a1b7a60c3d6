"""Start of the resolver, with a time-out, and search for launch files in packages."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from rosrm.errors import ConfigError, LaunchError
from rosrm.runtime.signalling import send_to_group
from rosrm.slave.launch.ament_index import find_package, search_path
from rosrm.wording import ending_of, get_close_matches, listed
from rosrm_launch.model import Failure, LaunchModel

#: Ends of the names of launch files.
ENDINGS: Final = ("launch.py", "launch.xml", "launch.yaml", "launch.yml")


def launch_file(words: Sequence[str]) -> Path:
    """Return the launch file that `FILE` or `PACKAGE FILE` names; raises `ConfigError`."""
    if len(words) == 1:
        path = Path(words[0])
        if not path.is_file():
            raise ConfigError(
                f"{path}: no such launch file; give PACKAGE FILE for one of a package"
            )
        return path.absolute()
    if len(words) != 2:
        raise ConfigError(
            "launch: give a launch file, or a package and the name of its launch file, and "
            "arguments as NAME:=VALUE"
        )
    package, name = words
    try:
        share = find_package(package, search_path(os.environ, sys.executable)) / "share" / package
    except LaunchError as error:
        raise ConfigError(str(error)) from None
    files = [path for path in share.rglob("*") if path.name.endswith(ENDINGS) and path.is_file()]
    found = [path for path in files if path.name == name]
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigError(f"{package} has {listed(map(str, found))}; give the path of one")
    names = sorted({path.name for path in files})
    close = get_close_matches(name, names, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"there: {listed(names) or 'none'}"
    raise ConfigError(f"the package {package!r} has no launch file {name!r}; {hint}")


def resolve(
    file: Path, arguments: Sequence[str], *, timeout: float, show_arguments: bool = False
) -> LaunchModel:
    """Return the model of a launch file, from a process of its own.

    Raises:
        ConfigError: the file cannot be resolved, or not in time.
    """
    words = [str(file), *arguments, *(["--show-args"] if show_arguments else [])]
    # Otherwise a folder `launch` in the current directory would hide the package.
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    with subprocess.Popen(
        [sys.executable, "-m", "rosrm_launch.resolve", *words],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, env=environment, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            output, _ = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            raise ConfigError(
                f"{file}: it was not resolved within {timeout:g} s, and was ended; "
                "`--resolve-timeout` allows more"
            ) from None
        finally:  # also what the launch file has started itself
            send_to_group(process.pid, signal.SIGKILL)
    return _answer(file, output, process.returncode)


def _answer(file: Path, output: bytes, status: int) -> LaunchModel:
    try:
        plain = json.loads(output)
    except ValueError:
        raise ConfigError(
            f"{file}: the resolver ended without a result: {ending_of(status)}"
        ) from None
    try:
        if "failure" in plain:
            raise ConfigError(Failure.model_validate(plain).failure)
        return LaunchModel.model_validate(plain)
    except ValidationError as error:
        raise ConfigError(f"{file}: the resolver gave no valid model: {error}") from None
