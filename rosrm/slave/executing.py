"""Executors: what plugins have done on this host in the open step of a plan."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rosrm.errors import Refused
from rosrm.ros.slave_endpoint import result_json

Executor = Callable[[Mapping[str, Any]], Mapping[str, Any]]
#: Told of the outcome: whether it worked, why not, and the result as JSON.
Done = Callable[[bool, str, str], None]


def execute(
    executors: Mapping[str, Executor], name: str, arguments: Mapping[str, Any], *, host: str,
    post: Callable[[Callable[[], None]], None], done: Done,
) -> None:  # fmt: skip
    """Run an executor in a thread of its own.

    Args:
        executors: that there are.
        name: of the one to run.
        arguments: a JSON object.
        host: name of this host.
        post: has something called in the loop.
        done: called in the loop with the outcome.

    Raises:
        Refused: there is none of this name.
    """
    function = executors.get(name)
    if function is None:
        there = ", ".join(sorted(executors)) or "none"
        raise Refused(f"no executor {name!r} on {host}; there are: {there}")

    def work() -> None:
        try:
            result = result_json(function(arguments))
            outcome = (True, "", result)
        except Exception as error:  # noqa: BLE001 - a third party's code: anything may come
            outcome = (False, f"{name} raised {type(error).__name__}: {error}", "")
        post(partial(done, *outcome))

    threading.Thread(target=work, name=f"executor {name}", daemon=True).start()
