"""Marks on settings whose form in a file differs from their value.

pydantic calls the hooks below when it reads a file; nothing else does, so that the settings can be
imported without it.
"""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from typing import Any, Final


@dataclass(frozen=True)
class NullIsEmpty:
    """Options may be left out after the colon: null stands for none."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Tells pydantic to put `{}` for null."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(
            lambda given: {} if given is None else given, handler(source)
        )


@dataclass(frozen=True)
class OptionsByName:
    """Plugins are named in a list, or in a mapping from name to options."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Tells pydantic to make a list of names a mapping to no options."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(self.named, handler(source))

    @staticmethod
    def named(given: Any) -> Any:
        """A list of names as a mapping; anything else as it is."""
        if not isinstance(given, list):
            return given
        strange = [name for name in given if not isinstance(name, str)]
        if strange:
            raise ValueError(f"{strange[0]!r} is not a name; options go into a mapping")
        twice = [name for name in given if given.count(name) > 1]
        if twice:
            raise ValueError(f"{twice[0]!r} is named twice")
        return {name: {} for name in given}


@dataclass(frozen=True)
class RosSection:
    """The section `ros` is nested in a file and flat as a value."""

    def in_file(self) -> type[Any]:
        """The form in a file."""
        from rosrm.config.ros import RosInFile  # noqa: PLC0415 - only files need pydantic

        return RosInFile

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Tells pydantic to read the file's form and to make the value of it."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        form: Any = self.in_file()
        return core_schema.no_info_after_validator_function(
            form.settings, handler.generate_schema(form)
        )


@dataclass(frozen=True)
class PlainWord:
    """Text that may be written without quotes even where YAML sees a number or a boolean."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Tells pydantic to make text of a scalar."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(self.text, handler(source))

    @staticmethod
    def text(given: Any) -> Any:
        """A scalar as text; anything else as it is."""
        if isinstance(given, bool):
            return "true" if given else "false"
        return str(given) if isinstance(given, (int, float)) else given


@dataclass(frozen=True)
class Words:
    """A list of words, or one text that is split as a shell would."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Tells pydantic to split a text."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(self.split, handler(source))

    @staticmethod
    def split(given: Any) -> Any:
        """A text or list as words; anything else as it is."""
        if not isinstance(given, str):
            return tuple(given) if isinstance(given, list) else given
        try:
            words = tuple(shlex.split(given))
        except ValueError as error:
            raise ValueError(f"{given!r} cannot be split into words: {error}") from None
        found = _SHELL_SYNTAX.search(_QUOTED.sub(_blank, given))
        if found:
            raise ValueError(
                f"{given!r} has {found[0].strip()!r} outside quotes, and no shell reads it. Write "
                f"[bash, -c, {json.dumps(given)}] for a shell, or quote {found[0].strip()!r} to "
                "pass it to the program as it is"
            )
        return words


#: Quoted and escaped parts of a text.
_QUOTED: Final = re.compile(r"""\\.|'[^']*'|"(?:\\.|[^"\\])*\"""", re.DOTALL)
#: Syntax that a shell would act on, `~` at the start of an argument included.
_SHELL_SYNTAX: Final = re.compile(r"&&|\|\||>>|<<|[|&;<>`*]|\$[\w{(]+|(?<=\s)~(?=/|\s|$)")


def _blank(quoted: re.Match[str]) -> str:
    return "_" * len(quoted[0])
