"""Process that resolves a launch file: `python -m rosrm_launch.resolve FILE [NAME:=VALUE...]`.

A launch file is a program: it may print, change the environment, exit, or never end. So it is
visited in a process of its own, whose only result is one line of JSON on the former standard
output; everything that the file prints goes to standard error.
"""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NoReturn

from rosrm_launch.model import Failure, LaunchModel

#: Packages whose lines do not help to find the error in a launch file.
_LAUNCH: Final = ("launch", "launch_ros")


def main() -> NoReturn:
    """Print the model of a launch file, or why there is none."""
    results = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    file, show_arguments = sys.argv[1], "--show-args" in sys.argv[2:]
    given = [word for word in sys.argv[2:] if ":=" in word]
    usual = tempfile.gettempdir()
    with tempfile.TemporaryDirectory(prefix="rosrm-launch-") as scratch:
        # launch makes a folder for its log, and leaves its files of parameters behind.
        os.environ["ROS_LOG_DIR"] = os.environ["TMPDIR"] = tempfile.tempdir = scratch
        answer = _answer(file, given, show_arguments=show_arguments)
    # Names of files that the processes will make.
    text = answer.model_dump_json(exclude_defaults=True).replace(scratch, usual)
    results.write(f"{text}\n")
    results.flush()
    os._exit(0)  # threads of the launch file may never end


def _answer(file: str, given: Sequence[str], *, show_arguments: bool) -> LaunchModel | Failure:
    try:
        from rosrm_launch import visiting  # noqa: PLC0415 - imports launch, which may be missing
    except Exception as error:  # noqa: BLE001 - of an installation that is not whole
        return Failure(
            failure=f"{sys.executable} cannot import `launch` and `launch_ros`: {error}. They come "
            "with a ROS installation: source its setup file, such as /opt/ros/jazzy/setup.bash, "
            "and install rosrm where its packages are seen (venv --system-site-packages)"
        )
    arguments = dict(word.split(":=", 1) for word in given)
    try:
        if show_arguments:
            return LaunchModel(file=file, arguments=visiting.declared(file))
        return visiting.resolved(file, arguments)
    except visiting.BadArguments as fault:
        return Failure(failure=f"{file}: {fault}")
    except SystemExit as end:
        return Failure(failure=f"{file} exits with {end.code!r} instead of describing a launch")
    except BaseException as error:  # noqa: BLE001 - of the launch file
        return Failure(failure=_described(error, file))


def _described(error: BaseException, file: str) -> str:
    """Return an error with the line of the launch file that caused it."""
    while error.__cause__ is not None:
        error = error.__cause__
    packages = [sys.modules[name] for name in _LAUNCH if name in sys.modules]
    folders = [Path(__file__).parent, *(Path(one.__path__[0]) for one in packages)]
    own = [
        one for one in traceback.extract_tb(error.__traceback__)
        if "launch" in Path(one.filename).name
        and not any(Path(one.filename).is_relative_to(folder) for folder in folders)
    ]  # fmt: skip
    where = f"{own[-1].filename}:{own[-1].lineno}" if own else file
    text = str(error).strip() or "no message"
    return f"{where}: {type(error).__name__}: {text}"


if __name__ == "__main__":
    main()
