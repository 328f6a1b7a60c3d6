"""Executors: what plugins have done on this host in the open step of a plan."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rosrm.errors import Refused, RosrmError
from rosrm.ros.slave_endpoint import result_json

Executor = Callable[[Mapping[str, Any]], Mapping[str, Any]]
#: Told of the outcome: whether it worked, why not, and the result as JSON.
Done = Callable[[bool, str, str], None]


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
        try:
            result = result_json(function(told))
            outcome = (True, "", result)
        except RosrmError as error:
            outcome = (False, str(error), "")
        except Exception as error:  # noqa: BLE001 - a third party's code: anything may come
            outcome = (False, f"{name} raised {type(error).__name__}: {error}", "")
        post(partial(done, *outcome))

    threading.Thread(target=work, name=f"executor {name}", daemon=True).start()
