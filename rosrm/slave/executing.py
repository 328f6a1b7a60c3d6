"""Executors: what plugins have done on this host in the open step of a plan."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rosrm.core.events import BAD_RESULT
from rosrm.errors import Refused, RosrmError, describe_plugin_fault

Executor = Callable[[Mapping[str, Any]], Mapping[str, Any]]
#: Told of the outcome: "" or the code of a failure, why it failed, and the result as JSON.
Done = Callable[[str, str, str], None]


@dataclass(frozen=True, slots=True)
class Here:
    """What an executor is told of its host, as `here`.

    Attributes:
        host: its name.
        state: the slave's directory.
        pids: of the leaders of the instances, by `process#number`; 0 of one that is to be started,
            at first or again.
    """

    host: str
    state: Path
    pids: Mapping[str, int]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        live = {instance: pid for instance, pid in self.pids.items() if pid}
        return {
            "host": self.host, "state": str(self.state), "pids": live,
            "instances": list(self.pids),
        }  # fmt: skip


def execute(
    executors: Mapping[str, Executor], name: str, arguments: Mapping[str, Any], *, here: Here,
    post: Callable[[Callable[[], None]], None], done: Done,
) -> None:  # fmt: skip
    """Run an executor in a thread of its own.

    Args:
        executors: that there are.
        name: of the one to run.
        arguments: a JSON object.
        here: where it runs.
        post: has something called in the loop.
        done: called in the loop with the outcome.

    Raises:
        Refused: there is none of this name.
    """
    function = executors.get(name)
    if function is None:
        there = ", ".join(sorted(executors)) or "none"
        raise Refused(f"no executor {name!r} on {here.host}; there are: {there}")

    told = {**arguments, "here": here.as_json()}

    def work() -> None:
        post(partial(done, *_outcome(name, function, told)))

    threading.Thread(target=work, name=f"executor {name}", daemon=True).start()


def _outcome(name: str, function: Executor, arguments: Mapping[str, Any]) -> tuple[str, str, str]:
    """Run an executor; returns as `Done` is called."""
    try:
        result: object = function(arguments)
        if not isinstance(result, Mapping):
            given = "None" if result is None else f"a {type(result).__name__}"
            return BAD_RESULT, f"{name} answered {given}; a JSON object is required", ""
        return "", "", json.dumps(result, default=dict)
    except RosrmError as error:
        return "failed", str(error), ""
    except BaseException as error:  # noqa: BLE001 - a third party's code, which may call sys.exit
        return "failed", f"{name} raised {describe_plugin_fault(error)}", ""
