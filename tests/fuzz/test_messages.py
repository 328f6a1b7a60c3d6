"""Messages of strangers: each is converted or refused, whatever its fields hold."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.errors import Refused
from rosrm.keys.security import NoSecurity
from rosrm.model.codec import to_plain
from rosrm.ros import convert
from rosrm.ros.master import services
from rosrm.ros.master.known_specs import KnownSpecs
from rosrm.ros.orders import journal_of, order_from_msg
from rosrm_msgs import msg, srv
from tests.fuzz.hostile import floats, fuzzed, json_values, texts

#: Texts that reach the part behind a first check.
WORDS = st.sampled_from(
    ["", "service", "job", "auto", "graph", "never", "always", "wait", "keep", "running", "held",
     "memory", "p", "run", "cordon"]
) | texts | json_values.map(json.dumps)  # fmt: skip
SENDER = NoSecurity().peer("user:ada", 0)


class Requests(services.MasterServices):
    """The conversions of requests, without ROS; every artifact is stored."""

    def __init__(self) -> None:
        self._queries = SimpleNamespace(has_artifact=lambda digest, size: True)
        self._known = KnownSpecs()


MASTER = Requests()
FLOAT32S = st.sampled_from([0.0, 0.5, 1.0, float("nan"), float("inf"), -float("inf"), 3e38, -1.0])


def messages_of(kind: Any) -> st.SearchStrategy[Any]:
    """Return a strategy for messages of a type, within the ranges of its fields."""
    hints = kind.get_fields_and_field_types()
    return st.deferred(
        lambda: st.builds(kind, **{name: _field(one) for name, one in hints.items()})
    )


def _field(type_name: str) -> st.SearchStrategy[Any]:
    inner = re.fullmatch(r"sequence<(.+?)(?:, \d+)?>", type_name)
    if inner:
        return st.lists(_field(inner[1]), max_size=3)
    array = re.fullmatch(r"(.+)\[(\d+)\]", type_name)
    if array:
        size = int(array[2])
        return st.lists(_field(array[1]), min_size=size, max_size=size)
    whole = re.fullmatch(r"(u?)int(\d+)", type_name)
    if whole:
        bits = int(whole[2])
        low, high = (0, (1 << bits) - 1) if whole[1] else (-(1 << bits - 1), (1 << bits - 1) - 1)
        return st.sampled_from([low, high, high // 2 + 1, 0, 1, 2])
    if "/" in type_name:
        return messages_of(getattr(msg, type_name.rpartition("/")[2]))
    limit = re.fullmatch(r"string<(\d+)>", type_name)
    if limit:
        return WORDS.map(lambda text: text[: int(limit[1])])
    return {
        "string": WORDS, "boolean": st.booleans(), "double": floats, "float": FLOAT32S,
        "octet": st.binary(min_size=1, max_size=1),
    }[type_name]  # fmt: skip


#: Each conversion of a received message, with the type of the message.
READERS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "spec": (msg.ProcessSpec, convert.spec_from_msg),
    "assignment": (msg.Assignment, convert.assignment_from_msg),
    "host": (msg.HostDescription, convert.host_from_msg),
    "status": (msg.ProcessStatus, convert.status_from_msg),
    "snapshot": (msg.SnapshotReport, convert.snapshot_from_msg),
    "restart": (msg.RestartPolicy, convert.restart_from_msg),
    "order": (srv.ControlHost.Request, order_from_msg),
    "journal": (srv.ControlHost.Request, journal_of),
    "submit": (srv.Submit.Request, lambda one: MASTER._submitted(one, 1, SENDER)),
    "apply": (srv.Apply.Request, lambda one: MASTER._applied(one, 1, SENDER)),
    "modes": (srv.LoadModes.Request, lambda one: MASTER._modes_loaded(one, 1, SENDER)),
    "mode": (srv.SwitchMode.Request, lambda one: services._mode_requested(one, 1, SENDER)),
    "cancel": (srv.Cancel.Request, lambda one: services._cancelled(one, 1, SENDER)),
    "migrate": (srv.Migrate.Request, lambda one: services._migrated(one, 1, SENDER)),
    "host state": (srv.SetHostState.Request, lambda one: services._host_set(one, 1, SENDER)),
    "prune": (srv.Prune.Request, lambda one: services._pruned(one, 1, SENDER)),
    "rebalance": (srv.Rebalance.Request, lambda one: services._rebalanced(one, 1, SENDER)),
    "event row": (msg.Event, convert.event_from_msg),
    "plugin row": (msg.PluginState, convert.plugin_row_from_msg),
    "host row": (msg.HostState, convert.host_row_from_msg),
    "process row": (msg.ProcessState, convert.process_row_from_msg),
}


@pytest.mark.parametrize("name", READERS)
@fuzzed(60)
@given(data=st.data())
def test_a_message_is_converted_or_refused(name, data):
    """The journal can hold each converted value."""
    kind, reader = READERS[name]
    message = data.draw(messages_of(kind))
    with contextlib.suppress(Refused):
        found = reader(message)
        if dataclasses.is_dataclass(found):
            json.dumps(to_plain(found))


@fuzzed(150)
@given(data=st.data())
def test_a_sound_spec_with_hostile_fields_is_converted_or_refused(data):
    """Most specs of the test above fall at the first check."""
    sound = msg.ProcessSpec(
        name="p", command=["run"], kind="service", readiness=msg.Readiness(kind="auto"),
        host_loss=msg.HostLossPolicy(then="wait"), isolation=msg.IsolationPolicy(then="keep"),
        restart=msg.RestartPolicy(when="never", factor=1.0),
        group=msg.GroupMembership(ends="never"),
    )  # fmt: skip
    hints = msg.ProcessSpec.get_fields_and_field_types()
    for name in data.draw(st.lists(st.sampled_from(sorted(hints)), max_size=4)):
        setattr(sound, name, data.draw(_field(hints[name])))
    with contextlib.suppress(Refused):
        json.dumps(to_plain(convert.spec_from_msg(sound)))
