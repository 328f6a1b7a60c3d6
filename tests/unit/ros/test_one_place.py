"""One place makes and opens sealed messages: no other module makes ROS entities of rosrm's own."""

from __future__ import annotations

import ast
from pathlib import Path

ROSRM = Path(__file__).parents[3] / "rosrm"
MAKERS = {
    "create_publisher", "create_subscription", "create_client", "create_service",
    "polled_subscription",
}  # fmt: skip
#: Types of messages that are encrypted or signed.
SAFE = {"Sealed", "msg.Sealed", "msg.SealedReading", "msg.Signed", "srv.Sealed"}
#: Modules that make entities of types that they do not name, with the reason.
OTHER_TYPES = {
    "node/container.py": "the services of containers in ROS 2",
    "node/managed_node.py": "the types of the user's node",
    "node/migratable.py": "the types of the user's node",
    "ros/master/diagnostics.py": "`/diagnostics`, which tools of ROS 2 read",
    "ros/participant.py": "`serve`, which sealed.py alone calls",
    "ros/polling.py": "the types of its callers",
    "ros/slave/flows.py": "topics of applications",
    "ros/slave/health.py": "topics and services of applications",
    "ros/slave/instance_clients.py": "services of applications",
    "ros/slave/publisher_watch.py": "topics of applications",
}


def made() -> dict[str, set[str]]:
    """Return the types of the ROS entities that each module makes."""
    found: dict[str, set[str]] = {}
    for path in ROSRM.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in MAKERS:
                first = 1 if name == "polled_subscription" else 0
                kind = ast.unparse(node.args[first])
                found.setdefault(str(path.relative_to(ROSRM)), set()).add(kind)
    return found


def test_rosrm_sends_and_receives_only_what_is_encrypted_or_signed() -> None:
    """Other types belong to applications."""
    unsafe = {module: kinds - SAFE for module, kinds in made().items() if kinds - SAFE}
    assert unsafe.keys() == OTHER_TYPES.keys()
    named = {kind for kinds in unsafe.values() for kind in kinds if "." in kind}
    assert not named & {kind for kind in named if kind.startswith(("msg.", "srv."))}


def test_only_sealed_services_are_served() -> None:
    """`Participant.serve` offers plain services, so only the sealed ones may use it."""
    plain = [
        str(path.relative_to(ROSRM))
        for path in ROSRM.rglob("*.py")
        if "participant.serve(" in path.read_text()
    ]
    assert plain == ["ros/sealed.py"]
