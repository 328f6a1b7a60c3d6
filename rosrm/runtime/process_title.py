"""Names of the parts of rosrm in `ps -e`, `top` and `pgrep`, which otherwise show "python"."""

from __future__ import annotations


def show_role(role: str) -> None:
    """Set the name of this process and of its later threads, e.g. to "rosrm-slave".

    The kernel keeps 15 bytes of the name. If /proc cannot be written, the name does not change.
    """
    try:
        with open("/proc/self/comm", "w", encoding="ascii") as name:
            name.write(f"rosrm-{role}")
    except PermissionError:
        return
