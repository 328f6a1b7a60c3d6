"""Variables of a process that its restarts need."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final, NamedTuple

from rosrm.runtime.ros_wheels import without_bootstrapper

#: Variables of ROS 2, its middlewares, and the search paths of its packages.
_OF_ROS: Final = re.compile(
    r"(ROS|RMW|RCL|RCUTILS|RCLCPP|FASTRTPS|FASTDDS|CYCLONEDDS|ZENOH)_.*"
    r"|AMENT_PREFIX_PATH|LD_LIBRARY_PATH|PYTHONPATH"
)
#: Words in the name of a variable that may hold a secret.
_SECRET: Final = re.compile(r"TOKEN|SECRET|PASSW|CREDENTIAL|_KEY$")
DOMAIN: Final = "ROS_DOMAIN_ID"
_DEFAULT_DOMAIN: Final = "0"


class Variables(NamedTuple):
    """The variables of a process.

    Attributes:
        taken: those of ROS with another value than on its host.
        left: names of the others that differ from those of its host.
    """

    taken: dict[str, str]
    left: list[str]


def variables_of(process: Mapping[str, str], host: Mapping[str, str]) -> Variables:
    """Return the variables of a process, compared with those that its host gives to processes."""
    own, others = without_bootstrapper(process), without_bootstrapper(host)
    own.setdefault(DOMAIN, _DEFAULT_DOMAIN)
    others.setdefault(DOMAIN, _DEFAULT_DOMAIN)
    differ = {name: value for name, value in own.items() if others.get(name) != value}
    taken = {name: value for name, value in differ.items() if _is_taken(name)}
    return Variables(taken, sorted(differ.keys() - taken))


def _is_taken(name: str) -> bool:
    return bool(_OF_ROS.fullmatch(name)) and not _SECRET.search(name)
