"""The names of rosrm's topics and services, below the configured namespace."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import Final

_FIT: Final = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")
_UNFIT: Final = re.compile(r"[^A-Za-z0-9]+")
_LONGEST: Final = 64
#: Hex digits of a digest: 128 bits, so that no second name with the same digest can be found.
_DIGITS: Final = 32
_ENDS_WITH_DIGEST: Final = re.compile(rf".*_[0-9a-f]{{{_DIGITS}}}")


def token(name: str) -> str:
    """Return a host's or process's name as a ROS name token; different names never share one.

    A name that is valid as it is stays: "robot_1". Any other name gets a digest: "robot-1" becomes
    "robot_1_" and 32 hex digits. A name that ends like a digest gets one too; otherwise it would be
    the token of another name. In DDS all servers of a name execute a request, so hosts with the
    same token would execute each other's orders.
    """
    if _FIT.fullmatch(name) and len(name) <= _LONGEST and not _ENDS_WITH_DIGEST.fullmatch(name):
        return name
    import hashlib  # noqa: PLC0415 - half a MiB, which plain names and nodes do not need

    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:_DIGITS]
    fit = _UNFIT.sub("_", name)[:_LONGEST].strip("_")
    return f"{fit}_{digest}" if fit[:1].isalpha() else f"host_{fit}_{digest}".replace("__", "_")


def client_node() -> str:
    """Return the node name of this process as a client of the master."""
    return f"rosrm_client_{os.getpid()}"


def slave_node(host: str) -> str:
    """Return the node name of the slave of a host; its other nodes have longer names."""
    return f"rosrm_slave_{token(host)}"


def is_slave_node(name: str) -> bool:
    """Return True for the name of a node of a slave."""
    return name.startswith("rosrm_slave_")


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

    @property
    def stranded_sources(self) -> str:
        """Topic on which silent sources ask the master if they may resume."""
        return f"{self.namespace}/handoff/stranded"


HANDSHAKE: Final = "handshake"
REGISTER_HOST: Final = "register_host"
LEAVE: Final = "leave"
REQUEST_PROCESS: Final = "request_process"
SUBMIT: Final = "submit"
APPLY: Final = "apply"
LOAD_MODES: Final = "load_modes"
SWITCH_MODE: Final = "switch_mode"
CANCEL: Final = "cancel"
KILL: Final = "kill"
RESTART: Final = "restart"
MIGRATE: Final = "migrate"
CHECKPOINT: Final = "checkpoint"
RESTORE: Final = "restore"
SET_HOST_STATE: Final = "set_host_state"
PRUNE: Final = "prune"
REBALANCE: Final = "rebalance"
RELOAD: Final = "reload"
LIST: Final = "list"
EXPLAIN: Final = "explain"
INTRODUCE: Final = "introduce"
CONTROL: Final = "control"
READ_LOG: Final = "read_log"
STORE_REPLICA: Final = "store_replica"
READ_SNAPSHOT: Final = "read_snapshot"
STORE_ARTIFACT: Final = "store_artifact"
READ_ARTIFACT: Final = "read_artifact"

RESOURCE_INFO: Final = "resource_info"
PROCESS_STATUS: Final = "process_status"
PROCESS_USAGE: Final = "process_usage"
SNAPSHOT_REPORTS: Final = "snapshot_reports"
MASTER_BEAT: Final = "master_beat"
MASTER_LOAD: Final = "master_load"
STATE_CONFIG: Final = "state_config"
#: Of ROS, below no namespace: monitors of all packages expect it there.
DIAGNOSTICS: Final = "/diagnostics"
