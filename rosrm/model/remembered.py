"""Cache of function results by the identity of the argument, which must not change.

Most processes have the same policies, and so the same objects. A look-up reads a few cache lines of
the CPU; the function would read all fields. After a pause, in which other programs have used the
CPU's caches, such reads take most of the time of a message.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar

_Argument = TypeVar("_Argument")
_Result = TypeVar("_Result")

#: Results that are kept for one function.
_KEPT: Final = 64


def remembered(
    function: Callable[[_Argument], _Result], is_kept: Callable[[_Result], bool] = lambda _: True
) -> Callable[[_Argument], _Result]:
    """Return a function that keeps the results for its newest arguments, which must not change.

    Args:
        function: the function; its result depends on its argument alone.
        is_kept: returns False for a result that would use too much memory.
    """
    known: dict[int, tuple[_Argument, _Result]] = {}

    def call(argument: _Argument) -> _Result:
        found = known.get(id(argument))
        if found is not None:
            return found[1]
        result = function(argument)
        if is_kept(result):
            if len(known) >= _KEPT:
                known.clear()
            # The entry keeps the argument, so no other object can have its identity.
            known[id(argument)] = argument, result
        return result

    return call
