"""Common arguments and helpers of the executors of `criu`."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rosrm.errors import CriuError, describe_fault
from rosrm_criu.engine import process_tree

_log: Final = logging.getLogger("rosrm.criu")
#: References to CRIU's logs, which are removed with the image; the message has the cause.
_LOG: Final = re.compile(r" \((its )?log: [^)]*\)")


@dataclass(frozen=True)
class StepArguments:
    """Arguments of every step.

    Attributes:
        process: its name.
        source, destination: numbers of its instances.
        attempt: id of the plan's attempt, also used in requests to the node.
        timeout: seconds for this step.
        host: name of this host.
        state: directory of the slave.
        pids: leaders of the instances that run here, by `process#number`.
        instances: all instances that have not ended here, in the same form.
        results: results of the executors of earlier steps, by executor name.
        arguments: all arguments.
    """

    process: str
    source: int
    destination: int
    attempt: str
    timeout: float
    host: str
    state: Path
    pids: Mapping[str, int]
    instances: Sequence[str]
    results: Mapping[str, Any]
    arguments: Mapping[str, Any]

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> StepArguments:
        """Return the arguments that the slave passed, parsed."""
        here = arguments["here"]
        return cls(
            str(arguments["process"]), int(arguments["source"]), int(arguments["destination"]),
            str(arguments["attempt"]), float(arguments["timeout"]), str(here["host"]),
            Path(here["state"]), here["pids"], here["instances"], arguments.get("results", {}),
            arguments,
        )  # fmt: skip

    def answer_of(self, step: str) -> Mapping[str, Any]:
        """Return the result of an earlier step; the master leaves out empty results."""
        answer: Mapping[str, Any] = self.results.get(step, {})
        return answer

    def pid(self, number: int) -> int:
        """Return the pid of the leader of an instance that lives here; 0: there is none."""
        pid = self.pids.get(f"{self.process}#{number}", 0)
        return pid if pid and process_tree.is_alive(pid) else 0

    def leader(self, number: int) -> int:
        """Return the same as `pid`; raise `CriuError` if there is none."""
        pid = self.pid(number)
        if not pid:
            raise CriuError(f"{self.process}#{number} does not run on {self.host}")
        return pid


@contextlib.contextmanager
def without_log_names() -> Iterator[None]:
    """Remove the names of CRIU's logs from its errors, because the logs vanish with the image."""
    try:
        yield
    except CriuError as error:
        raise CriuError(_LOG.sub("", str(error))) from None


@contextlib.contextmanager
def undoing(*steps: Callable[[], object]) -> Iterator[None]:
    """Call all steps after an error in this context; the error of a step is only logged.

    The first error is the one to report, and no step needs the success of another one.
    """
    try:
        yield
    except BaseException as first:
        for step in steps:
            try:
                step()
            except Exception as fault:  # noqa: BLE001 - see above
                _log.error("%s; then: %s", describe_fault(first), describe_fault(fault))
        raise
