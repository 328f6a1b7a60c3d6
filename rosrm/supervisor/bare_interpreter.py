"""Entry point of the supervisor's bare interpreter: `-I -S bare_interpreter.py STATE LIMITS`.

Without site-packages (-S) no `.pth` file runs: neither the ROS wheels' bootstrapper nor an
environment's imports. So this file finds the `rosrm` package, which contains it, by its own path.

The process writes one line to its standard output, "ready" or an error, and then closes it.
"""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Listen in the state directory, report readiness, and serve until the shutdown."""
    package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    sys.path.append(os.path.dirname(package))  # last: the standard library takes precedence

    # ruff: noqa: PLC0415 - these can be imported only now
    from rosrm.runtime import file_thread, oom_score, timer_slack
    from rosrm.runtime.process_title import show_role
    from rosrm.supervisor import descriptors, endpoint, own_log
    from rosrm.supervisor.logs import LogLimits
    from rosrm.supervisor.server import Server

    state, *limits = sys.argv[1:]
    show_role("supervisor")
    file_thread.let_threads_wait()
    timer_slack.use_usual_timers()  # for the processes of users
    oom_score.protect()  # the slave, which cannot do it either then, logs why
    try:
        listener = endpoint.listen(state)
    except endpoint.EndpointError as error:
        sys.exit(f"{error}")
    log_limits = LogLimits(*(int(limit) for limit in limits))
    server = Server(state, listener, log_limits, files=descriptors.raise_limit())
    endpoint.let_go_of_terminal(state)
    own_log.use_thread(server.disk.begin)
    server.run()


main()
