"""Program that checks a settings file, and prints the settings as JSON for a runtime that runs."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

from rosrm.config.cluster import load_cluster
from rosrm.config.host import load_host
from rosrm.errors import RosrmError
from rosrm.extensions.registry import Registry
from rosrm.runtime.process_end import end_now


def main(role: str, path: str, domain: str) -> int:
    """Print the settings, or on the error output why the file is invalid; return the exit code.

    Args:
        role: "master" or "slave".
        path: of the file.
        domain: ROS domain that replaces the one of the file; "": none.
    """
    # A plugin may print when it is imported or called: that goes to the error output.
    output = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    registry = Registry.discover()
    try:
        config = (load_cluster if role == "master" else load_host)(path, registry)
    except RosrmError as fault:
        sys.stderr.write(f"{fault}\n")
        return fault.exit_code
    if domain:
        config = replace(config, ros=replace(config.ros, domain=int(domain)))
    with output:
        output.write(config.to_json())
    return 0


if __name__ == "__main__":
    end_now(main(*sys.argv[1:]))
