"""Quantities with units, for rosrm's settings and for the options of plugins.

A field annotated with one of these types accepts a number in base units or text with a unit, and
refuses a value out of its range. Only the validation of a file imports pydantic here, because the
runtimes of master and slave start without it::

    @dataclass(frozen=True)
    class Options:
        window: Seconds = 10.0      # 10, "10s", "500ms", "2min"
        cache: Bytes = 0            # 1048576, "1MiB", "500 MB"
        weight: Fraction = 1.0      # 0..1
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

from rosrm.model.durations import LONGEST
from rosrm.model.values import LARGEST_RATE
from rosrm.wording import get_close_matches

_SIZES: Final = {
    "B": 1.0,
    "kB": 1e3,
    "KB": 1e3,
    "MB": 1e6,
    "GB": 1e9,
    "TB": 1e12,
    "KiB": 2.0**10,
    "MiB": 2.0**20,
    "GiB": 2.0**30,
    "TiB": 2.0**40,
}
_RATES: Final = {f"{unit}/s": factor for unit, factor in _SIZES.items()}
_CORES: Final = {"core": 1.0, "cores": 1.0}
_DURATIONS: Final = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}

#: Factors to the base unit, by measured quantity.
UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "number": {},
    "duration": _DURATIONS,
    "size": _SIZES,
    "cores": _CORES,
    "rate": _RATES,
    "amount": {**_SIZES, **_RATES, **_CORES},
}
_EXAMPLES: Final = {
    "duration": '"500ms" or "10s"',
    "size": '"500MB" or "2GiB"',
    "cores": '"0.5 cores"',
    "rate": '"30MB/s"',
    "amount": '"500MB" or "0.5 cores"',
}

_NUMBER_AND_UNIT: Final = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)\s*")


class UnfitAmount(ValueError):
    """An amount that fits no resource; `of` returns a more precise message for one resource."""

    def __init__(self, text: str, given: object) -> None:
        super().__init__(text)
        self.given = given

    def of(self, resource: str) -> str:
        """Return the fault of the amount for one resource."""
        try:
            amount_of(resource, self.given)
        except ValueError as error:
            return str(error)
        return str(self)


@dataclass(frozen=True)
class Quantity:
    """Annotation of a number that may have a unit and must lie within a range.

    Attributes:
        measures: key of `UNITS` with the allowed units. A duration is at most ten years.
        low: lowest allowed value.
        high: highest allowed value.
        above: True: the value must be greater than `low`.
        whole: True: the value must be a whole number.
        hint: text added to the message on a value out of range.
    """

    measures: str = "number"
    low: float = 0.0
    high: float = math.inf
    above: bool = False
    whole: bool = False
    hint: str = ""

    def parse(self, given: object) -> float:
        """Return the value in base units; raise `ValueError` with the allowed values."""
        value = self._number(given)
        if not math.isfinite(value) or self._outside(value):
            hint = f" ({self.hint})" if self.hint else ""
            raise ValueError(f"{given!r} is not {self.range()}{hint}")
        if self.measures == "duration" and value > LONGEST:
            raise ValueError(f"{given!r} is longer than ten years")
        if self.whole and value != int(value):
            raise ValueError(f"{given!r} is not a whole number")
        return int(value) if self.whole else value

    def range(self) -> str:
        """Return the allowed values as text."""
        if math.isfinite(self.high):
            form = ".0f" if self.whole else "g"
            return f"within {self.low:{form}}..{self.high:{form}}"
        return f"greater than {self.low:g}" if self.above else f"at least {self.low:g}"

    def _outside(self, value: float) -> bool:
        return value < self.low or value > self.high or (self.above and value == self.low)

    def _number(self, given: object) -> float:
        if isinstance(given, (int, float)) and not isinstance(given, bool):
            try:
                return float(given)
            except OverflowError:  # an integer of more than 308 digits
                return math.inf
        found = _NUMBER_AND_UNIT.fullmatch(given) if isinstance(given, str) else None
        if found is None:
            raise ValueError(f"{given!r} is not {self._form()}")
        number, unit = found.groups()
        return float(number) * self._factor(unit)

    def _factor(self, unit: str) -> float:
        units = UNITS[self.measures]
        if not unit:
            return 1.0
        if unit in units:
            return units[unit]
        if not units:
            raise ValueError(f"a number without a unit is required, not one with {unit!r}")
        by_case = [known for known in units if known.lower() == unit.lower()]
        near = by_case or get_close_matches(unit, units, 1)
        meant = f"; did you mean {near[0]!r}?" if near else "."
        raise ValueError(f"unknown unit {unit!r}{meant} Allowed: {', '.join(units)}")

    def _form(self) -> str:
        if self.measures == "number":
            return "a whole number" if self.whole else "a number"
        return f"a number, or text such as {_EXAMPLES[self.measures]}"

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return a schema with which pydantic calls `parse`; only pydantic calls this."""
        from pydantic_core import core_schema  # noqa: PLC0415 - only files need pydantic

        return core_schema.no_info_plain_validator_function(self._parse_in_file)

    def _parse_in_file(self, given: object) -> float:
        try:
            return self.parse(given)
        except ValueError as error:
            if self.measures == "amount":
                raise UnfitAmount(str(error), given) from None
            raise


#: Duration of at least 0: `10`, `"500ms"`, `"2min"`.
Seconds = Annotated[float, Quantity("duration")]
#: Duration greater than 0.
PositiveSeconds = Annotated[float, Quantity("duration", above=True)]
ByteRate = Annotated[float, Quantity("rate", high=LARGEST_RATE)]
PositiveByteRate = Annotated[float, Quantity("rate", high=LARGEST_RATE, above=True)]
#: Size: `1048576`, `"1MiB"`, `"500 MB"`.
Bytes = Annotated[int, Quantity("size", whole=True)]
#: Number from 0 to 1: `0.8` means 80 %.
Fraction = Annotated[float, Quantity(high=1.0, hint="a fraction: 0.8 means 80 %")]
#: Whole number of at least 0.
Count = Annotated[int, Quantity(high=2**31 - 1, whole=True)]
#: Whole number of at least 1.
PositiveCount = Annotated[int, Quantity(low=1, high=2**31 - 1, whole=True)]
ANY_AMOUNT: Final = Quantity("amount")
#: Amount of any resource; `amount_of` is stricter where the resource is known.
Amount = Annotated[float, ANY_AMOUNT]


class IsResource:
    """Annotation of text that names a resource; a name that no probe reads is refused in a file."""


#: Name of a resource that an installed probe reads.
ResourceName = Annotated[str, IsResource()]

_MEASURES: Final = {"memory": "size", "disk": "size", "cpu": "cores"}


def amount_of(resource: str, given: object) -> float:
    """Return an amount of one resource in base units; raise `ValueError`, also for a wrong unit."""
    return Quantity(_MEASURES.get(resource, "amount")).parse(given)
