"""Import of the types of `rosrm_msgs` one by one, on first use.

The generated packages `rosrm_msgs.msg` and `rosrm_msgs.srv` import all of their types, which takes
4 MiB and tens of milliseconds. A slave or a command uses a third of them.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any, Final, cast

_PACKAGES: Final = frozenset({"rosrm_msgs.msg", "rosrm_msgs.srv"})
_PART_OF_SERVICE: Final = re.compile(r"_(Request|Response|Event)$")
#: Where ROS inserts "_" into the name of a type to name its module.
_WORD: Final = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=.)(?=[A-Z][a-z])")


class _LazyPackageLoader:
    """Loader of a generated package; it does not execute the package's `__init__`."""

    def create_module(self, _: ModuleSpec) -> None:
        """Leave the creation of the module to the import system."""

    def exec_module(self, module: ModuleType) -> None:
        """Let the first access to a type import the module of this type."""
        vars(module)["__getattr__"] = partial(_imported, module)


class _Finder:
    """Finder of the generated packages, ahead of the usual finders."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, _: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a generated package, with another loader; None for other modules."""
        spec = PathFinder.find_spec(name, path) if name in _PACKAGES else None
        if spec is not None:
            # Not derived from the class of `importlib.abc`, whose import needs half a MiB.
            spec.loader = cast(Any, _LazyPackageLoader())
        return spec


def _imported(package: ModuleType, name: str) -> Any:
    """Import a type, and keep it as an attribute of its package."""
    if name.startswith("_"):  # the import system asks for attributes that a package may have
        raise AttributeError(name)
    module = f"{package.__name__}._{_WORD.sub('_', _PART_OF_SERVICE.sub('', name)).lower()}"
    try:
        found = getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        raise AttributeError(f"{package.__name__} has no type {name!r}") from error
    setattr(package, name, found)
    return found


def import_types_lazily() -> None:
    """Make the generated packages import each type on its first use."""
    sys.meta_path.insert(0, _Finder)
