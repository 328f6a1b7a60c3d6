"""Arguments of a launch file: declared, missing and unknown ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from launch import LaunchContext
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.utilities import perform_substitutions

from rosrm.wording import get_close_matches, listed
from rosrm_launch.model import Argument
from rosrm_launch.visiting.state import Visit


class BadArguments(Exception):
    """Arguments of a launch file that are missing or unknown."""


def declared(file: str) -> list[Argument]:
    """Return the arguments that a file declares, as `ros2 launch --show-args` does."""
    context = LaunchContext(noninteractive=True)
    description = AnyLaunchDescriptionSource(file).get_launch_description(context)
    found = {one.name: one for one in description.get_launch_arguments()}
    return [_argument(one, context) for one in found.values()]


def declare(visit: Visit, action: Any) -> None:
    """Declare an argument, and note it."""
    visit.arguments.setdefault(action.name, _argument(action, visit.context))
    action.execute(visit.context)


def check_required(visit: Visit, description: Any) -> None:
    """Raise `BadArguments` if an argument without a default is not given."""
    missing = [
        one for one in description.get_launch_arguments()
        if one.default_value is None and not one._conditionally_included  # noqa: SLF001
        and one.name not in visit.given
    ]  # fmt: skip
    if missing:
        wanted = listed([f"{one.name} ({one.description})" for one in missing])
        raise BadArguments(
            f"required: {wanted}; write {missing[0].name}:=VALUE. `--show-args` lists all"
        )


def check_known(visit: Visit) -> None:
    """Raise `BadArguments` if an argument was given that the files neither declare nor ask for."""
    known = list(visit.arguments)
    unknown = [name for name in visit.given if name not in {*known, *visit.asked}]
    if unknown:
        raise BadArguments(_about_unknown(unknown, known))


def _argument(action: Any, context: LaunchContext) -> Argument:
    default = action.default_value
    try:
        text = None if default is None else perform_substitutions(context, default)
    except Exception:  # noqa: BLE001 - it depends on other arguments
        text = "".join(part.describe() for part in default)
    return Argument(
        name=action.name, default=text, description=action.description or "",
        choices=list(action.choices or ()),
    )  # fmt: skip


def _about_unknown(names: Sequence[str], known: Sequence[str]) -> str:
    close = [near for name in names for near in get_close_matches(name, list(known), 1)]
    hint = f"; did you mean {listed(close, 'or')}?" if close else ""
    own = listed(list(known)) if known else "none"
    return f"it declares no argument {listed(list(names))}{hint or '.'} Its arguments: {own}"
