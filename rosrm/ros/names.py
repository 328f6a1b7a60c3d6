"""The names of rosrm's topics and services, below the configured namespace."""

from __future__ import annotations

import os
import re
import zlib
from dataclasses import dataclass
from typing import Final

_FIT: Final = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")
_UNFIT: Final = re.compile(r"[^A-Za-z0-9]+")
_LONGEST: Final = 64


def token(name: str) -> str:
    """Return a host's or process's name as a ROS name token: "robot-1" -> "robot_1_bd82fad2".

    A changed name gets a digest, so that different names stay different. In DDS all servers of a
    name execute a request, so otherwise robot-1 would execute the orders for robot_1.
    """
    if _FIT.fullmatch(name) and len(name) <= _LONGEST:
        return name
    digest = f"{zlib.crc32(name.encode('utf-8', 'surrogatepass')):08x}"
    fit = _UNFIT.sub("_", name)[:_LONGEST].strip("_")
    return f"{fit}_{digest}" if fit[:1].isalpha() else f"host_{fit}_{digest}".replace("__", "_")


def client_node() -> str:
    """Return the node name of this process as a client of the master."""
    return f"rosrm_client_{os.getpid()}"


@dataclass(frozen=True, slots=True)
class Names:
    """Names below a namespace."""

    namespace: str

    def __call__(self, name: str) -> str:
        """Return a name that all components share."""
        return f"{self.namespace}/{name}"

    def of_host(self, host: str, name: str) -> str:
        """Return a name that belongs to one host."""
        return f"{self.namespace}/host/{token(host)}/{name}"

    def of_handoff(self, process: str, destination: int) -> str:
        """Return the channel of one handoff, named by its destination's instance number."""
        return f"{self.namespace}/handoff/{token(process)}_{destination}"


HANDSHAKE: Final = "handshake"
REGISTER_HOST: Final = "register_host"
LEAVE: Final = "leave"
REQUEST_PROCESS: Final = "request_process"
SUBMIT: Final = "submit"
CANCEL: Final = "cancel"
RESTART: Final = "restart"
MIGRATE: Final = "migrate"
CHECKPOINT: Final = "checkpoint"
RESTORE: Final = "restore"
SET_HOST_STATE: Final = "set_host_state"
PRUNE: Final = "prune"
LIST: Final = "list"
EXPLAIN: Final = "explain"
CONTROL: Final = "control"
READ_LOG: Final = "read_log"
KEEP_STATE: Final = "keep_state"
READ_KEPT: Final = "read_kept"

RESOURCE_INFO: Final = "resource_info"
PROCESS_STATUS: Final = "process_status"
PROCESS_USAGE: Final = "process_usage"
KEPT_STATES: Final = "kept_states"
MASTER_BEAT: Final = "master_beat"
MASTER_LOAD: Final = "master_load"
STATE_CONFIG: Final = "state_config"
