"""Rules for the secrets of a process, checked at every boundary."""

from __future__ import annotations

from collections.abc import Iterator

from rosrm.model.values import ProcessSpec


def secrets_fault(spec: ProcessSpec) -> str:
    """Return the first fault of the secrets of a process; "": none."""
    return next((fault for _, fault in secret_faults(spec)), "")


def secret_faults(spec: ProcessSpec) -> Iterator[tuple[str, str]]:
    """Yield the variable of each faulty secret with its fault."""
    for name, path in spec.secrets.items():
        if not is_variable(name, path):
            yield name, f"secrets: {name!r:.100} cannot be a variable"
        elif name == "PATH" or name.startswith("ROSRM_"):
            # A program that is not found is reported with the PATH in which it was looked up.
            yield name, f"secrets.{name}: rosrm itself sets or reads {name}; use another variable"
        elif not path.startswith("/"):
            yield (
                name,
                (
                    f"secrets.{name}: {path!r:.250} is no absolute path. A host reads the file, so "
                    "write its whole path there, as /etc/robot/token"
                ),
            )
        elif name in spec.environment:
            yield name, f"secrets.{name}: `environment` sets {name}, too; leave one of them out"


def is_variable(name: str, value: str) -> bool:
    """Return True if a program can get an environment variable of this name and value."""
    return bool(name) and "=" not in name and "\0" not in name + value
