"""A client of the master, on its host, driven by lines: `{"do": ...}` in, one line out for each.

`submit` and `apply` take the path of a work file, `cancel` names, `migrate` a process and a host.
`application` returns the state of an application, and why it returned to its former version. `look`
returns the states of hosts and processes, for the log of a violation, and the silent hosts by the
master's events, which confirm a measured stall. `events` returns the newest events of a process, as
lines. The client ends when its input ends.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from rosrm import Client, EventRow, NoMaster, RosrmError

#: Seconds for finding a master; a request has 10.
_PATIENCE = 3.0
#: Newest events of a process, and the most letters of one as a line.
_EVENTS = 25
_LONGEST = 160


def main() -> None:
    """Answer requests until the input ends."""
    client: Client | None = None
    for line in sys.stdin:
        try:
            client = client or Client(timeout=_PATIENCE)
            answer = _answer(client, json.loads(line))
        except NoMaster as error:
            answer = {"no_master": str(error)}
            if client is not None:
                client.close()  # a new client knows of no earlier master
                client = None
        except RosrmError as error:
            answer = {"refused": str(error)}
        print(json.dumps(answer), flush=True)


def _answer(client: Client, request: dict[str, Any]) -> dict[str, Any]:
    if request["do"] == "submit":
        return {"message": client.submit(request["work"])}
    if request["do"] == "apply":
        return {"message": client.apply(request["work"]).message}
    if request["do"] == "application":
        row = client.get_application(request["name"])
        returned = "" if row.returned_from is None else row.returned_from.given_up
        return {"state": row.state, "returned": returned, "pending": dict(row.pending)}
    if request["do"] == "cancel":
        return {"message": client.cancel(request["names"])}
    if request["do"] == "migrate":
        return {"message": client.migrate(request["process"], request["host"])}
    if request["do"] == "events":
        events = client.list(events=True, process=request["process"], newest=_EVENTS).events
        return {"events": [_line_of(one) for one in events]}
    view = client.list(hosts=True, processes=True, events=True, newest=200)
    return {
        "hosts": {row.description.name: row.state for row in view.hosts},
        "accepting": [row.description.name for row in view.hosts if row.accepting],
        "processes": {
            row.name: f"{row.state} {row.host} #{row.number} {row.reason}".strip()
            for row in view.processes
        },
        "silent": [
            [one.wall_time, one.host]
            for one in view.events
            if one.kind in ("host_suspect", "host_lost")
        ],
        "events": [f"{one.elapsed:.2f} {one.kind}: {one.message}" for one in view.events],
    }


def _line_of(event: EventRow) -> str:
    when = time.strftime("%H:%M:%S", time.localtime(event.wall_time))
    return f"{when} {event.kind}: {event.message}"[:_LONGEST]


if __name__ == "__main__":
    main()
