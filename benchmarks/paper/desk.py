"""A client of the master on a host of the lab, driven by lines from outside of it.

    python -m benchmarks.paper.desk

Each line of standard input is a JSON object, and each is answered by a line: `{"do": "submit",
"work": FILE}` queues the processes of a work file; `{"do": "look", "after": N}` returns the states
of hosts and processes, and the events after number N. The client ends when its input ends.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

from rosrm import Client, HostRow, RosrmError

#: Seconds for a master that is starting on a busy machine.
_PATIENCE = 60.0


def main() -> None:
    """Answer requests until the input ends."""
    with Client(timeout=_PATIENCE) as client:
        print(json.dumps({"connected": True}), flush=True)
        for line in sys.stdin:
            try:
                answer = _answer(client, json.loads(line))
            except RosrmError as error:
                answer = {"error": str(error)}
            print(json.dumps(answer), flush=True)


def _answer(client: Client, request: dict[str, Any]) -> dict[str, Any]:
    if request["do"] == "submit":
        return {"message": client.submit(request["work"])}
    view = client.list(hosts=True, processes=True, events=True, after=request["after"])
    return {
        "elapsed": view.uptime,
        "hosts": {row.description.name: _host(row) for row in view.hosts},
        "states": {row.name: row.state for row in view.processes},
        "reasons": {row.name: row.reason for row in view.processes if row.reason},
        "memory": {row.name: row.memory for row in view.processes},
        "events": [
            {
                "sequence": event.sequence, "elapsed": event.elapsed,
                "wall_time": event.wall_time, "kind": event.kind, "process": event.process,
                "host": event.host, "message": event.message, "facts": dict(event.facts),
            }
            for event in view.events
        ],
    }  # fmt: skip


def _host(row: HostRow) -> dict[str, Any]:
    memory = next((one for one in row.resources if one.name == "memory"), None)
    known = memory is not None and not memory.stale and math.isfinite(memory.usage)
    return {
        "accepting": row.accepting,
        "usage": memory.usage if memory is not None and known else None,
        "in_flight": memory.in_flight if memory is not None and known else 0.0,
        "capacity": memory.capacity if memory is not None else 0.0,
    }


if __name__ == "__main__":
    main()
