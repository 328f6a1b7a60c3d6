"""Changes of the restart policy of running instances, as in handoffs, and memos."""

from __future__ import annotations

import os

import pytest

from rosrm.core.supervisor.events import RestartOrdered, StopOrdered
from rosrm.model.values import InstanceId, InstanceState, RestartPolicy
from rosrm.supervisor.client_values import key_of
from rosrm.supervisor.messages import Remember
from tests.waiting import wait_until

from .conftest import kill

NEVER = RestartPolicy("never")
ON_FAILURE = RestartPolicy("on-failure", delay=0.05)
SAYS_WHAT_IT_IS = ("sh", "-c", "echo shadow: $ROSRM_SHADOW; exec sleep 1000")

#: Kill of the supervisor before or after the change.
KILLS = pytest.mark.parametrize("killed", ["before", "after"])


def shadow(host, name: str, **options):
    """Return an order as the slave makes it for the destination of a handoff."""
    environment = {**os.environ, "ROSRM_SHADOW": "1"}
    return host.order(name, *SAYS_WHAT_IT_IS, environment=environment, restart=NEVER, **options)


def amended(host, client, name: str, restart: RestartPolicy, killed: str):
    """Set the policy, with a SIGKILL of the supervisor before or after; return the client."""
    if killed == "before":
        client = host.replace_supervisor(client)
    host.amend(client, name, restart)
    if killed == "after":
        client = host.replace_supervisor(client)
    return client


def kill_after_output(host, pid: int, name: str) -> None:
    """Kill a run that has printed its output."""
    wait_until(lambda: host.log(name).exists() and host.log(name).read_text(), "it has spoken")
    kill(pid)


@KILLS
def test_a_suspended_policy_lets_the_source_end(host, client, killed):
    """With `never` the end of the source is final, although its order has a restart policy."""
    client.start([host.order("source", *SAYS_WHAT_IT_IS, restart=ON_FAILURE)])
    pid = host.running(client, "source").pid
    client = amended(host, client, "source", NEVER, killed)
    kill_after_output(host, pid, "source")
    status = host.ended(client, "source")
    assert (status.state, status.restarts) == (InstanceState.FAILED, 0)


@KILLS
def test_a_confirmed_shadow_is_restarted_as_none(host, client, killed):
    """A confirmed shadow follows its policy, and its next run has no ROSRM_SHADOW."""
    client.start([shadow(host, "copy")])
    pid = host.running(client, "copy").pid
    client = amended(host, client, "copy", ON_FAILURE, killed)
    kill_after_output(host, pid, "copy")
    status = host.wait(client, "copy", InstanceState.RUNNING)
    assert (status.restarts, status.pid != pid) == (1, True)
    said = "shadow: 1\nshadow:\n"
    wait_until(lambda: host.log("copy").read_text() == said, "both runs have spoken")


def test_an_end_while_no_supervisor_runs_follows_the_new_policy(host, client):
    """The next supervisor applies the recorded policies to processes that died with the former."""
    client.start([shadow(host, "copy"), host.order("source", "sleep", "9", restart=ON_FAILURE)])
    source = host.running(client, "source").pid
    host.amend(client, "copy", ON_FAILURE)
    host.amend(client, "source", NEVER)
    client = host.reconnect(client)
    copy = next(one.pid for one in client.instances if one.instance.process == "copy")
    host.kill_supervisor(client)
    kill(source, copy)
    client = host.connect()
    found = {one.instance.process: one.state for one in client.instances}
    assert found == {"copy": InstanceState.BACKOFF, "source": InstanceState.FAILED}


def test_an_unconfirmed_shadow_is_never_restarted(host, client):
    """An unconfirmed shadow does not restart, even after restarts of slave and supervisor."""
    client.start([shadow(host, "copy")])
    pid = host.running(client, "copy").pid
    client = host.replace_supervisor(client)
    kill_after_output(host, pid, "copy")
    assert host.ended(client, "copy").state is InstanceState.FAILED
    client = host.reconnect(client)
    assert [one.state for one in client.instances] == [InstanceState.FAILED]


def test_a_restart_on_order_makes_no_shadow_of_a_confirmed_one(host, client):
    """A restart on a user's order does not set ROSRM_SHADOW of a confirmed shadow again."""
    client.start([shadow(host, "copy")])
    host.running(client, "copy")
    wait_until(lambda: host.log("copy").read_text(), "it has spoken")
    host.amend(client, "copy", NEVER)
    client.send(RestartOrdered(("copy", 1)))
    host.wait(client, "copy", InstanceState.STARTING)
    said = "shadow: 1\nshadow:\n"
    wait_until(lambda: host.log("copy").read_text() == said, "both runs have spoken")


def test_memos_outlive_slave_and_supervisor(host, client):
    """Memos outlive slave and supervisor (SIGKILL), and end with their instance."""
    kept, other = InstanceId("kept", 1), InstanceId("other", 1)
    orders = [host.order("kept", "sleep", "1000", memo="a"), host.order("other", "sleep", "1000")]
    client.start(orders)
    host.running(client, "other")
    client = host.reconnect(client)
    assert client.memos == {kept: "a"}
    client.send(Remember(key_of(kept), "b"))
    client.send(Remember(key_of(other), "c"))
    client.send(StopOrdered(key_of(kept)))
    host.ended(client, "kept")  # by then the supervisor has read the orders
    client.send(Remember(key_of(kept), "too late"))
    host.amend(client, "other", NEVER)
    client = host.replace_supervisor(client)
    assert client.memos == {other: "c"}
