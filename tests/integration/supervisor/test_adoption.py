"""Adoption: a real process that the test has started becomes an instance of a real supervisor."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from rosrm.core.supervisor.events import RestartOrdered, StopOrdered
from rosrm.core.supervisor.rules import AdoptionRule
from rosrm.model.values import InstanceState, Limits, ProcessSpec, RestartPolicy
from rosrm.supervisor import procfs
from rosrm.supervisor.client_values import limit_rule
from tests.waiting import wait_gone, wait_until

ALWAYS = RestartPolicy("always", delay=0.0)
DEAF_CHILD = """
import signal, subprocess, sys, time
deaf = (
    "import signal, time; signal.signal(2, signal.SIG_IGN); signal.signal(15, signal.SIG_IGN); "
    "print('deaf', flush=True); time.sleep(1000)"
)
child = subprocess.Popen([sys.executable, "-c", deaf])
print(child.pid, flush=True)
signal.signal(signal.SIGINT, lambda *_: sys.exit())
time.sleep(1000)
"""


@pytest.fixture
def start():
    """Start processes without rosrm; they are killed after the test."""
    started = []

    def run(*words: str, **options) -> subprocess.Popen:
        process = subprocess.Popen(words, stdout=subprocess.PIPE, **options)
        started.append(process)
        threading.Thread(target=process.wait, daemon=True).start()  # as a shell reaps its children
        return process

    yield run
    for process in started:
        process.kill()
        process.stdout.close()


def rule_of(pid: int) -> AdoptionRule:
    """Return the rule by which a running process is adopted."""
    stat = procfs.read_stat(pid)
    assert stat is not None
    return AdoptionRule(pid, stat.start, procfs.boot_id())


def adopt(host, client, pid: int, *, name: str = "mine", **options) -> None:
    """Adopt a process; its restarts sleep."""
    client.start([host.order(name, "sleep", "1000", adoption=rule_of(pid), **options)])
    assert host.running(client, name).pid == pid


def refusal(host, client, rule: AdoptionRule) -> str:
    """Return why the supervisor refuses to adopt a process."""
    client.start([host.order("refused", "sleep", "1000", adoption=rule)])
    status = host.ended(client, "refused")
    assert status.state is InstanceState.REFUSED
    assert host.alive() == []  # nothing was started instead
    return status.message


def test_the_end_of_an_adopted_process_is_seen_without_its_exit_code(host, client, start):
    """Only a parent gets the exit code, so an end with code 0 is no success either."""
    process = start("sh", "-c", "read line; exit 0", stdin=subprocess.PIPE)
    adopt(host, client, process.pid)
    process.stdin.close()
    status = host.ended(client, "mine")
    assert (status.state, status.exit_code) == (InstanceState.FAILED, -1)
    assert status.known_exit is None
    assert (
        status.message == "ended; its exit code is not known, because rosrm did not start this run"
    )


def test_a_stop_reaches_the_adopted_process_and_its_children_alone(host, client, start):
    """The others of its process group are not its own, such as the script that started it."""
    process = start("sh", "-c", "sleep 1000 & echo $!; wait", preexec_fn=os.setpgrp)
    beside = start("sleep", "1000", preexec_fn=lambda: os.setpgid(0, process.pid))
    child = int(process.stdout.readline())
    adopt(host, client, process.pid)
    client.send(StopOrdered(("mine", 1)))
    status = host.ended(client, "mine")
    assert status.state is InstanceState.EXITED
    wait_gone(process.pid)
    wait_gone(child)
    assert beside.poll() is None


def test_a_child_that_outlives_its_adopted_parent_is_killed(host, client, start):
    """The instance ends when the child has ended, which ignores SIGINT and SIGTERM."""
    process = start(sys.executable, "-c", DEAF_CHILD)
    child, deaf = int(process.stdout.readline()), process.stdout.readline()
    assert deaf == b"deaf\n"
    adopt(host, client, process.pid)
    client.send(StopOrdered(("mine", 1)))
    status = host.ended(client, "mine")
    assert status.message.startswith("stopped by SIGINT, SIGTERM after")
    assert "SIGKILL" in status.message
    stat = procfs.read_stat(child)
    assert stat is None or not stat.alive


def test_a_restart_starts_the_program_of_the_order(host, client, start):
    """The first run is adopted, each later one is a child of the supervisor, with its output."""
    process = start("sleep", "1000")
    order = host.order("mine", "sh", "-c", "echo new; sleep 1000", adoption=rule_of(process.pid))
    client.start([order])
    assert host.running(client, "mine").pid == process.pid
    client.send(RestartOrdered(("mine", 1)))
    pid = host.running(client, "mine").pid
    wait_gone(process.pid)
    assert procfs.read_marks(pid)[0] == "mine#1"
    adopted, output = host.log("mine").read_text, f"process {process.pid} was adopted"
    wait_until(lambda: adopted().endswith("new\n"), "the output of the new run is in the log")
    assert output in adopted()


def test_the_restart_policy_holds_for_an_adopted_process(host, client, start):
    """A process that ends is started again by the order."""
    process = start("sleep", "1000")
    adopt(host, client, process.pid, restart=ALWAYS)
    process.kill()
    assert host.running(client, "mine").pid not in (0, process.pid)


def test_an_adopted_process_survives_its_supervisor(host, client, start):
    """The next supervisor finds the process by pid and start time, and can stop it."""
    process = start("sleep", "1000")
    adopt(host, client, process.pid)
    client = host.replace_supervisor(client)
    (status,) = client.instances
    assert (status.state, status.pid) == (InstanceState.RUNNING, process.pid)
    client.send(StopOrdered(("mine", 1)))
    assert host.ended(client, "mine").state is InstanceState.EXITED
    wait_gone(process.pid)


def test_an_adoption_that_was_ordered_is_carried_out_by_the_next_supervisor(host, client, start):
    """A supervisor that is killed before the adoption leaves the order in its record."""
    process = start("sleep", "1000")
    adopt(host, client, process.pid)
    host.kill_supervisor(client)
    host.cut_record(after_spawn=False)
    client = host.connect()
    found = {one.state: one.pid for one in client.instances}
    pid = found.get(InstanceState.RUNNING) or host.running(client, "mine").pid
    assert pid == process.pid


def test_limits_hold_from_the_first_restart(host, client, start):
    """An adopted process stays in its control group, and the status says so."""
    process = start("sleep", "1000")
    limits = limit_rule(ProcessSpec("mine", limits=Limits(memory=1e9)))
    order = host.order("mine", "sleep", "1000", adoption=rule_of(process.pid), limits=limits)
    client.start([order])
    status = host.running(client, "mine")
    assert status.enforced == ()
    assert status.message == "adopted, so only its first restart applies limits.memory"


# --- refusals ---------------------------------------------------------------------------------


def test_a_process_that_has_ended_is_not_adopted(host, client, start):
    """A zombie has ended, too."""
    process = start("sleep", "1000")
    rule = rule_of(process.pid)
    process.kill()
    wait_gone(process.pid)
    assert refusal(host, client, rule) == f"process {process.pid} is not adopted: it has ended"


def test_another_process_with_the_pid_is_not_adopted(host, client, start):
    """The start time tells a reused pid apart."""
    process = start("sleep", "1000")
    rule = rule_of(process.pid)
    why = refusal(host, client, rule._replace(birth=rule.birth - 200))
    assert why.endswith("it has ended, and another process has its pid now")
    assert process.poll() is None


def test_a_process_of_another_boot_is_not_adopted(host, client, start):
    """Its start time says nothing after a restart of the machine."""
    process = start("sleep", "1000")
    why = refusal(host, client, rule_of(process.pid)._replace(boot="another"))
    assert why.endswith("it ran before a restart of this host")


def test_the_first_process_is_not_adopted(host, client):
    """The machine would stop with it."""
    assert refusal(host, client, rule_of(1)).endswith("it is the first process of its machine")


def test_the_supervisor_is_not_adopted(host, client):
    """No process of rosrm is."""
    assert refusal(host, client, rule_of(client.pid)).endswith("it belongs to rosrm")


@pytest.mark.parametrize("module", ["rosrm.slave", "rosrm.master", "rosrm.cli"])
def test_parts_of_rosrm_are_not_adopted(host, client, start, module):
    """They are recognised by their command lines, also of another cluster."""
    code = "import sys; print(flush=True); sys.stdin.read()"
    process = start(sys.executable, "-c", code, "-m", module, stdin=subprocess.PIPE)
    process.stdout.readline()
    assert refusal(host, client, rule_of(process.pid)).endswith("it belongs to rosrm")


def test_a_process_above_rosrm_is_not_adopted(host, client, start):
    """A stop would reach the slave that was started in this shell."""
    part = f"{sys.executable} -c 'import time; time.sleep(1000)' -m rosrm.slave"
    process = start("sh", "-c", f"{part} & echo $!; wait; true")
    below = int(process.stdout.readline())
    try:
        wait_until(lambda: "-m" in procfs.command_line(below), "the part is executed")
        why = refusal(host, client, rule_of(process.pid))
        assert why.endswith("a process of rosrm is among its descendants")
    finally:
        os.kill(below, signal.SIGKILL)


def test_an_instance_is_not_adopted(host, client):
    """Neither as itself nor as a second process."""
    pid = host.sleeper(client, "first")
    client.start([host.order("second", "sleep", "1000", adoption=rule_of(pid))])
    status = host.ended(client, "second")
    assert status.state is InstanceState.REFUSED
    assert status.message.endswith("it belongs to the process first already")


def test_parent_and_child_are_not_both_adopted(host, client, start):
    """A process belongs to one instance."""
    process = start("sh", "-c", "sleep 1000 & echo $!; wait")
    child = int(process.stdout.readline())
    adopt(host, client, child, name="child")
    client.start([host.order("parent", "sleep", "1000", adoption=rule_of(process.pid))])
    why = host.ended(client, "parent").message
    assert why.endswith(f"its descendant {child} belongs to the process child already")
    os.kill(child, signal.SIGKILL)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_a_process_of_another_user_is_not_adopted(host, client, start):
    """The right to run programs as one user is none to stop those of others."""
    process = start("sleep", "1000", user=65534)
    why = refusal(host, client, rule_of(process.pid))
    assert why.endswith("it runs as another user than this one (uid 0)")


def test_a_kernel_thread_is_not_adopted(host, client):
    """A thread of the kernel has no program to start again."""
    threads = [stat.pid for stat in procfs.everyone() if stat.is_kernel_thread and stat.pid > 1]
    if not threads:
        pytest.skip("no thread of the kernel is visible here")
    assert refusal(host, client, rule_of(threads[0])).endswith("it is a thread of the kernel")
