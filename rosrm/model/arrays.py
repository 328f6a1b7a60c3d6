"""Arrays: jobs of one entry of a work file that differ in an index."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

#: Largest index of an array, and most of its jobs at a time.
LARGEST_INDEX: Final = 2**31 - 1
#: Name of the index between the braces of a placeholder.
INDEX: Final = "array.index"
#: Placeholder of the index, with or without a format: `{array.index:03d}`.
INDEX_PLACEHOLDER: Final = re.compile(r"\{array\.index(?::[^{}]*)?\}")
#: Variable with the index of a job.
INDEX_VARIABLE: Final = "ROSRM_ARRAY_INDEX"


@dataclass(frozen=True, slots=True)
class ArrayMembership:
    """The array of a job, and its index there.

    Attributes:
        name: name of the array; "": the process belongs to none.
        index: 0 or above.
        parallel: most jobs of the array that are placed at a time; 0: no bound.
    """

    name: str = ""
    index: int = 0
    parallel: int = 0


NO_ARRAY: Final = ArrayMembership()
