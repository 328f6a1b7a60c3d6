"""Outcomes of the steps of a plan, and of requests that may be refused."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rosrm.core.master.commands import RefusalCode


class StepProgress(Enum):
    """Progress of the current step of a plan that has not failed."""

    PENDING = "pending"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class StepFailed:
    """The current step of a plan failed.

    Attributes:
        reason: a sentence.
        timed_out: True if the time-out of the step has passed.
    """

    reason: str
    timed_out: bool = False


StepOutcome = StepProgress | StepFailed


def done_if(condition: bool) -> StepProgress:
    """Return DONE if a condition holds, else PENDING."""
    return StepProgress.DONE if condition else StepProgress.PENDING


@dataclass(frozen=True, slots=True)
class Rejected:
    """A requested plan, destination or setting is not available.

    Attributes:
        reason: a sentence.
    """

    reason: str


class RequestRefused(Exception):
    """A client's request is refused, and nothing has changed; the message goes to the client."""

    def __init__(self, message: str, code: RefusalCode = "invalid") -> None:
        super().__init__(message)
        self.code = code
