"""The names of rosrm's topics and services, below the configured namespace."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

_UNFIT: Final = re.compile(r"[^A-Za-z0-9_]")


def token(name: str) -> str:
    """A host's name as one token of a ROS name ("robot-1" -> "robot_1", "3d" -> "h3d")."""
    fit = _UNFIT.sub("_", name)
    return fit if fit[:1].isalpha() else f"h{fit}"


@dataclass(frozen=True, slots=True)
class Names:
    """Names below a namespace."""

    namespace: str

    def __call__(self, name: str) -> str:
        return f"{self.namespace}/{name}"

    def of_host(self, host: str, name: str) -> str:
        """A name that belongs to one host."""
        return f"{self.namespace}/host/{token(host)}/{name}"


HANDSHAKE: Final = "handshake"
REGISTER_HOST: Final = "register_host"
LEAVE: Final = "leave"
REQUEST_PROCESS: Final = "request_process"
SUBMIT: Final = "submit"
CANCEL: Final = "cancel"
RESTART: Final = "restart"
MIGRATE: Final = "migrate"
SET_HOST_STATE: Final = "set_host_state"
LIST: Final = "list"
EXPLAIN: Final = "explain"
CONTROL: Final = "control"
READ_LOG: Final = "read_log"

RESOURCE_INFO: Final = "resource_info"
PROCESS_STATUS: Final = "process_status"
PROCESS_USAGE: Final = "process_usage"
MASTER_BEAT: Final = "master_beat"
