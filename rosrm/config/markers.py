"""Annotations of settings with another form in a file than as a value.

Only pydantic calls these hooks, when it validates a file. So the settings do not import pydantic.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from rosrm.config.shell_words import Role, shell_words


@dataclass(frozen=True)
class NullIsEmpty:
    """Annotation of options that a file may leave empty; null means no options."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that replaces null by `{}`."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(
            lambda given: {} if given is None else given, handler(source)
        )


@dataclass(frozen=True)
class OptionsByName:
    """Annotation of plugins given as a list of names, or as a mapping from name to options."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that converts a list of names into a mapping to no options."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(self.named, handler(source))

    @staticmethod
    def named(given: Any) -> Any:
        """Return a list of names as a mapping; any other value unchanged."""
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
class OneOrMore:
    """Annotation of a list of mappings, of which a file may give a single one without a list.

    Attributes:
        item: type of one mapping.
    """

    item: type[Any]

    def in_file(self) -> Any:
        """Return the type of the value as written in a file."""
        return self.item | tuple[self.item, ...]  # type: ignore[name-defined]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that converts a single mapping into a list of one."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        one = core_schema.no_info_after_validator_function(
            lambda item: (item,), handler.generate_schema(self.item)
        )
        return core_schema.tagged_union_schema(
            {"one": one, "many": handler(source)},
            discriminator=lambda given: "many" if isinstance(given, (list, tuple)) else "one",
        )


@dataclass(frozen=True)
class RosSection:
    """Annotation of the section `ros`, which is nested in a file and flat as a value."""

    def in_file(self) -> type[Any]:
        """Return the type of the section as written in a file."""
        from rosrm.config.ros import RosInFile  # noqa: PLC0415 - only files need pydantic

        return RosInFile

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that reads the file's form and converts it into the value."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        form: Any = self.in_file()
        return core_schema.no_info_after_validator_function(
            form.settings, handler.generate_schema(form)
        )


@dataclass(frozen=True)
class ProcessSection:
    """Annotation of a section with the keys of a process, which `rosrm.config.work` checks."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that leaves the section to its own check."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_plain_validator_function(lambda _: None)


@dataclass(frozen=True)
class PlainWord:
    """Annotation of text that needs no quotes, even if YAML reads it as a number or boolean.

    Attributes:
        boolean: False: a boolean is refused, because it is probably no name but a wrong form.
    """

    boolean: bool = True

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that converts a scalar into text."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(self.text, handler(source))

    def text(self, given: Any) -> Any:
        """Return a scalar as text; any other value unchanged."""
        if isinstance(given, bool):
            return json.dumps(given) if self.boolean else given
        return str(given) if isinstance(given, (int, float)) else given


@dataclass(frozen=True)
class Words:
    """Annotation of a list of words, or of one text that is split by the rules of a shell.

    Attributes:
        role: of the first word.
    """

    role: Role = "name"

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that splits a text into words."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_before_validator_function(self.split, handler(source))

    def split(self, given: Any) -> Any:
        """Return a text or list as words; any other value unchanged.

        Raises:
            ValueError: the text cannot be split, or a shell would do more than split it.
        """
        if not isinstance(given, str):
            return tuple(given) if isinstance(given, list) else given
        if "$(find-pkg-" in given:
            raise ValueError(f"{given!r}: write a list of words where a package is named by $(…)")
        return shell_words(given, self.role)
