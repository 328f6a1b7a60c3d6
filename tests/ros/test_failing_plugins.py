"""Third-party plugins that raise, hang or give bad answers: named, skipped and survived."""

from __future__ import annotations

import os
import signal
import textwrap
import time

import pytest

from rosrm.config.settings import MigrationSettings, ScoringChoice
from rosrm.errors import Refused
from rosrm.model.values import MigrationPolicy
from tests.ros.clusters import host, job, service
from tests.waiting import PATIENCE, wait_until

PLUGIN = """
import os, sys, time
import numpy as np
from pathlib import Path
from rosrm.model.plan import AwaitReady, Commit, Execute, Plan, Start, Stop
from rosrm.model.values import Reading, ResourceDescription
from rosrm.extensions.hookspecs import hookimpl
from rosrm.errors import SkipPlugin
from dataclasses import replace
from rosrm.extensions.contracts import (
    Capabilities, FilterOffer, LauncherOffer, MigrationOffer, ProbeOffer, ScoringOffer, Scores
)

class Policy:
    def __init__(self, act): self.act = act
    def score(self, hosts, process):
        if process.spec.name.startswith("fine"): return Scores(np.zeros(len(hosts.names)))
        return Scores(self.act(len(hosts.names)))

def named(name, act):
    return ScoringOffer(name, lambda options: Policy(act), reads=("name",))

def raises(count): raise RuntimeError("the policy is out of order")
def hangs(count):
    while True:
        try: sum(range(1000))
        except BaseException: pass

@hookimpl
def register_scoring_policies():
    return [
        named("raises", raises), named("hangs", hangs),
        named("exits", lambda count: sys.exit(3)),
    ]

class Filter:
    def __init__(self, act): self.act = act
    def mask(self, hosts, process): return self.act(hosts)
    def reason(self, hosts, process, row): return f"it is called {hosts.names[row]}"

@hookimpl
def register_filters():
    acts = {
        "not_h0": lambda hosts: np.array([name != "h0" for name in hosts.names]),
        "raises": raises, "hangs": hangs, "exits": lambda hosts: sys.exit(3),
    }
    return [FilterOffer(name, lambda options, act=act: Filter(act)) for name, act in acts.items()]

class Probe:
    def __init__(self, name, act):
        self.resources = [ResourceDescription(name, "1", 1.0)]
        self.name, self.act = name, act
    def read(self):
        return [Reading(self.name, self.act())]
    def close(self): pass

def fails(): raise OSError("no such sensor")
def sleeps():
    time.sleep(1000)
def comes_back():
    if not (Path(__file__).parent / "sensor").exists(): raise OSError("unplugged")
    return 0.5
class NoUnit(Probe):
    def __init__(self, name, act):
        super().__init__(name, act)
        self.resources = [ResourceDescription(name, None, 1.0)]
def absent(options, context): raise SkipPlugin("no such hardware here")
def broken(options, context): raise ValueError("cannot be made")
def probe(name, act):
    return ProbeOffer(name, lambda options, context: Probe(name, act), deadline=0.3)

@hookimpl
def register_probes():
    return [
        probe("battery", lambda: 0.25), probe("fails", fails), probe("sleeps", sleeps),
        probe("comes_back", comes_back),
        ProbeOffer("no_unit", lambda options, context: NoUnit("no_unit", lambda: 0.0)),
        ProbeOffer("absent_one", absent), ProbeOffer("broken_one", broken),
    ]

class Strategy:
    def propose(self, move): raise ValueError("not on a Sunday")

@hookimpl
def register_migration_strategies():
    return [
        MigrationOffer("never_plans", lambda options: Strategy()),
        MigrationOffer("hangs", lambda options: Acting(hangs_long)),
        MigrationOffer("exits", lambda options: Acting(lambda: sys.exit(3))),
        *(MigrationOffer(name, lambda options, name=name: Executing(name), executors={name: act})
          for name, act in EXECUTORS.items()),
        MigrationOffer(
            "imager", lambda options: Imager(),
            executors={"imager.save": save, "imager.take": take, "imager.drop": drop},
            capabilities=Capabilities(state="memory", launcher="imager"),
        ),
    ]

# --- images, with a launcher of its own

class Imager:
    def propose(self, move): raise ValueError("it stays on its host")
    def checkpoint(self, move):
        here, seconds = move.source_host, 10.0
        names = {"source": str(move.source), "destination": str(move.destination)}
        undo = Execute("imager.drop", here, {"process": "", "numbers": []}, seconds)
        return Plan((
            Execute("imager.save", here, names, seconds, undo=undo),
            Commit(image="imager.drop"), Stop(move.source, here, seconds),
        ))
    def restore(self, move):
        here, seconds = move.destination_host, 10.0
        names = {"source": str(move.source), "destination": str(move.destination)}
        return Plan((
            Execute("imager.take", here, names, seconds),
            Start(move.destination, here, seconds, restored=True), Commit(),
        ))

def image(state, instance): return Path(state) / f"imager-{instance}"
def save(arguments):
    path = image(arguments["here"]["state"], arguments["source"])
    path.write_text("what " + arguments["source"] + " knew")
    return {}
def take(arguments):
    state = arguments["here"]["state"]
    saved = image(state, arguments["source"])
    if saved.exists(): saved.rename(image(state, arguments["destination"]))
    return {}
def drop(arguments): return {}

class ByImage:
    def __init__(self, context): self.state = context.state
    def prepare(self, launch):
        saved = image(self.state, launch.assignment.instance)
        if launch.assignment.restored and not saved.exists(): return None
        knows = saved.read_text() if launch.assignment.restored else "nothing yet"
        return replace(launch, environment={**launch.environment, "IMAGER_KNOWS": knows})

@hookimpl
def register_launchers():
    return [
        LauncherOffer("imager", ByImage, variables=("IMAGER_KNOWS",)),
        LauncherOffer("absent_launcher", absent_launcher),
        LauncherOffer("broken_launcher", lambda context: None),
    ]

def absent_launcher(context): raise SkipPlugin("no container engine here")

class Acting:
    def __init__(self, act): self.act = act
    def propose(self, move): self.act()

class Executing:
    # Its executor is called on the source before anything else, and to undo that.
    def __init__(self, name): self.name = name
    def propose(self, move):
        undo = Execute(self.name, move.source_host, {"begins": False}, 60.0)
        begin = Execute(self.name, move.source_host, {"begins": True}, 60.0, undo=undo)
        return Plan((
            begin, Start(move.destination, move.destination_host, 30.0),
            AwaitReady(move.destination, move.destination_host, 30.0),
            Commit(), Stop(move.source, move.source_host, 30.0),
        ), overlap=60.0)

def hangs_long():
    while True: time.sleep(0.01)
def forgets(arguments): pass
def forgets_slowly(arguments): time.sleep(2.0)
def exits(arguments):
    if arguments["begins"]: sys.exit(3)
    return {}
EXECUTORS = {"forgets": forgets, "forgets_slowly": forgets_slowly, "exits_there": exits}
"""


@pytest.fixture(scope="module")
def third_party(tmp_path_factory):
    """Yield a folder as pip would create it, with a module and its entry point."""
    site = tmp_path_factory.mktemp("site")
    (site / "odd_plugin.py").write_text(PLUGIN)
    (site / "bad_import.py").write_text("import no_such_module_at_all\n")
    info = site / "odd_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        textwrap.dedent("""\
        [rosrm]
        odd = odd_plugin
        bad = bad_import
        """)
    )
    # The process that starts a part finds the plugins; the part itself imports them.
    before = os.environ.get("PYTHONPATH", "")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(site), *([before] if before else [])]))
        patch.syspath_prepend(site)
        yield site


def plugins(cluster) -> list:
    """Return the rows of `rosrm plugins`."""
    return list(cluster.client.list(plugins=True).plugins)


# --- scoring ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "said"),
    [("raises", "out of order"), ("hangs", "1 s"), ("exits", "SystemExit: 3")],
)
def test_a_policy_that_fails_is_left_out_and_named(make_cluster, third_party, policy, said) -> None:
    """A process is placed without the failing policy, with an event; the master keeps running.

    The policy that hangs also catches its interrupt.
    """
    cluster = make_cluster(host("h0"), scoring=(ScoringChoice(policy),))
    cluster.submit(job("judged", "true"))
    event = cluster.wait_for_event("plugin_failed", says=f"'{policy}'")
    assert said in event.message
    assert cluster.ended("judged").state == "finished"
    assert policy in str(cluster.client.explain("judged"))
    (row,) = [row for row in plugins(cluster) if (row.kind, row.name) == ("scoring", policy)]
    assert (row.state, said in row.reason) == ("failing", True)
    began = time.monotonic()
    for number in range(5):
        assert cluster.run(job(f"more{number}", "true"))[0].state == "finished"
    assert time.monotonic() - began < PATIENCE  # not awaited again and again
    cluster.wait_until("h0 up", lambda v: [row.state for row in v.hosts] == ["up"])


# --- filters ----------------------------------------------------------------------------------


def test_a_filter_excludes_hosts_with_its_reason(make_cluster, third_party) -> None:
    """The master asks the filter that the configuration names, and explains it."""
    cluster = make_cluster(host("h0"), host("h1"), filters={"not_h0": {}})
    jobs = cluster.run(*(job(f"judged{number}", "true") for number in range(3)))
    assert {row.host for row in jobs} == {"h1"}
    hosts = cluster.client.explain("judged0")["decision"]["hosts"]
    reasons = {row["name"]: row["reason"] for row in hosts}
    assert reasons["h0"] == "it is called h0 (filter not_h0)"


@pytest.mark.parametrize(
    ("name", "said"), [("raises", "out of order"), ("hangs", "1 s"), ("exits", "SystemExit: 3")]
)
def test_a_filter_that_fails_lets_processes_wait(make_cluster, third_party, name, said) -> None:
    """No host is chosen without the rule; the master continues to answer, and names the filter."""
    cluster = make_cluster(host("h0"), filters={name: {}})
    cluster.submit(job("judged", "true"))
    event = cluster.wait_for_event("plugin_failed", says=f"'{name}'")
    assert said in event.message
    (reason,) = [row["reason"] for row in cluster.client.explain("judged")["decision"]["hosts"]]
    assert reason.startswith(f"the filter {name} failed: ")
    cluster.stays(1.0, lambda: cluster.process("judged").state == "queued", "queued")
    (row,) = [row for row in plugins(cluster) if (row.kind, row.name) == ("filter", name)]
    assert (row.state, said in row.reason) == ("failing", True)
    cluster.cancel("judged")


# --- probes -----------------------------------------------------------------------------------


def probes(*names: str) -> dict:
    return {"memory": {}, "cpu": {}, **{name: {} for name in names}}


@pytest.fixture(scope="module")
def cluster(make_shared, third_party):
    """Yield a host with all these probes, and a limit on the working one."""
    names = ("battery", "fails", "sleeps", "absent_one", "broken_one")
    return make_shared(host("h0", probes=probes(*names), limits={"battery": 0.5}))


def test_a_probe_of_a_third_party_is_read(cluster) -> None:
    """A third party's resource has a limit, a reading in the rows, and counts in needs."""

    def shown(view) -> bool:
        battery = next(r for row in view.hosts for r in row.resources if r.name == "battery")
        return (battery.usage, battery.limit) == (0.25, 0.5)

    cluster.wait_until("a reading of the battery", shown)
    assert cluster.run(job("light", "true", needs={"battery": 0.1}))[0].state == "finished"
    cluster.submit(service("heavy", needs={"battery": 0.4}))
    cluster.wait_for_event("waits", process="heavy")
    assert "battery" in str(cluster.client.explain("heavy"))
    cluster.cancel("heavy")


@pytest.mark.parametrize("name", ["fails", "sleeps"])
def test_a_probe_that_fails_is_stale_never_zero(cluster, name) -> None:
    """A failing probe stops new work, until it works, only where its resource has a limit."""
    works, waits, limited = f"works-{name}", f"waits-{name}", f"limited-{name}"
    assert cluster.run(job(works, "true"))[0].state == "finished"
    wait_until(lambda: name in cluster.log_of("h0"), f"a log line of h0 about {name}")
    assert "Traceback" not in cluster.log_of("h0")

    part = cluster.start_slave(host(limited, probes=probes(name), limits={name: 0.9}))

    def stale(view) -> bool:
        rows = [row for row in view.hosts if row.description.name == limited]
        return any(r.stale and r.usage > 0.0 for row in rows for r in row.resources)

    cluster.wait_until(f"{name} stale on {limited}", stale)
    cluster.client.set_host_state("h0", "cordon")
    cluster.submit(job(waits, "true"))
    waiting = ("queued", "set_aside")
    cluster.stays(1.0, lambda: cluster.process(waits).state in waiting, "no host takes it")
    assert not cluster.host(limited).accepting
    cluster.cancel(waits)
    cluster.client.set_host_state("h0", "uncordon")
    assert cluster.end(part, signal.SIGINT) == 0


def test_a_probe_that_fails_is_listed_until_it_works_again(make_cluster, third_party) -> None:
    """The row has the error and its place in the code; both changes are events of the host."""
    sensor = third_party / "sensor"
    sensor.unlink(missing_ok=True)
    cluster = make_cluster(host("h0", probes=probes("comes_back")))

    def row():
        return next(row for row in plugins(cluster) if row.name == "comes_back" and row.host)

    cluster.wait_for_event("plugin_failed", says="the probe of comes_back on h0 fails: ")
    assert row().state == "failing"
    assert "OSError: unplugged (" in row().reason
    assert "odd_plugin.py:" in row().reason
    sensor.touch()
    cluster.wait_for_event("plugin_works", host="h0")
    assert row().state == "selected"


def test_a_probe_that_cannot_be_made_fails_from_the_start(make_cluster, third_party) -> None:
    """Log, event and row name plugin and place; a limit on the resource stops new work."""
    cluster = make_cluster()
    cluster.start_slave(host("h0", probes=probes("no_unit"), limits={"no_unit": 0.9}))
    event = cluster.wait_for_event("plugin_failed", says="the probe of no_unit on h0 fails: ")
    (row,) = [row for row in plugins(cluster) if row.name == "no_unit" and row.host]
    for said in (event.message, row.reason, cluster.log_of("h0")):
        assert "plugin 'odd' of odd-plugin 1.0: NoUnit (" in said
        assert "odd_plugin.py:" in said
        assert "the unit None" in said
    assert row.state == "failing"
    cluster.submit(job("waits", "true"))
    wait_until(
        lambda: "its reading of no_unit is stale" in str(cluster.client.explain("waits")),
        "the reason why h0 takes nothing",
    )
    cluster.cancel("waits")


def test_a_probe_that_is_absent_or_broken_is_listed(cluster) -> None:
    """The rows have the reasons; the host works with its other probes."""
    rows = {row.name: row for row in cluster.client.list(plugins=True).plugins if row.host == "h0"}
    assert (rows["absent_one"].state, rows["absent_one"].reason) == (
        "absent", "no such hardware here",
    )  # fmt: skip
    assert rows["broken_one"].state == "failing"
    assert "cannot be made" in rows["broken_one"].reason
    assert rows["memory"].state == "selected"
    assert cluster.run(job("works", "true"))[0].state == "finished"


# --- migration --------------------------------------------------------------------------------


STRATEGIES = ("never_plans", "hangs", "exits", "forgets", "exits_there", "forgets_slowly")


@pytest.fixture(scope="module")
def pair(make_shared, third_party):
    """Yield two hosts, and all these strategies."""
    strategies = {name: {} for name in (*STRATEGIES, "relaunch")}
    return make_shared(host("h0"), host("h1"), migration=MigrationSettings(strategies))


@pytest.fixture
def moving(pair, request):
    """Yield a process of the strategy that the test names; it must run on as it was."""
    strategy = request.param
    pair.submit(service(strategy, migration=MigrationPolicy(strategy)))
    before = pair.wait(strategy, "running")
    yield before
    assert pair.wait(strategy, "running").pid == before.pid
    assert pair.run(job(f"after-{strategy}", "true"))[0].state == "finished"
    pair.cancel(strategy)


@pytest.mark.parametrize("moving", ["never_plans"], indirect=True)
def test_a_strategy_that_gives_no_plan(pair, moving) -> None:
    """The refusal has the strategy's name and reason; the process stays."""
    with pytest.raises(Refused, match=r"never_plans.*not on a Sunday"):
        pair.client.migrate(moving.name)


@pytest.mark.parametrize(
    ("moving", "said"), [("hangs", "longer than 1 s"), ("exits", "Exit: 3")], indirect=["moving"]
)
def test_a_strategy_that_hangs_or_exits(pair, moving, said) -> None:
    """The refusal comes within the deadline, the strategy is failing, the master works on."""
    strategy = moving.name
    with pytest.raises(Refused, match=rf"{strategy}.*{said}.*odd_plugin\.py:"):
        pair.client.migrate(strategy)
    failed = f"the migration strategy '{strategy}' fails: propose: "
    pair.wait_for_event("plugin_failed", says=failed)
    (row,) = [row for row in plugins(pair) if (row.kind, row.name) == ("migration", strategy)]
    assert (row.state, "odd_plugin.py:" in row.reason) == ("failing", True)


@pytest.mark.parametrize(
    ("moving", "said"),
    [
        ("forgets", "forgets answered None; a JSON object is required"),
        ("exits_there", "exits_there raised SystemExit: 3"),
    ],
    indirect=["moving"],
)
def test_an_executor_that_fails(pair, moving, said) -> None:
    """The step fails with this message, the migration is undone, the process keeps running.

    The strategy is listed as failing on the host.
    """
    strategy = moving.name
    pair.client.migrate(strategy)
    assert said in pair.wait_for_event("stayed", process=strategy).message
    failed = f"the migration strategy '{strategy}' on {moving.host} fails: executor "
    pair.wait_for_event("plugin_failed", says=failed)
    rows = [row for row in plugins(pair) if row.name == strategy and row.host == moving.host]
    assert [(row.state, said in row.reason) for row in rows] == [("failing", True)]


@pytest.mark.parametrize("moving", ["forgets_slowly"], indirect=True)
def test_an_executor_that_answers_none_to_a_killed_master(pair, moving) -> None:
    """The repeated step fails again, so the migration is undone, not repeated forever."""
    pair.client.migrate(moving.name)
    pair.wait(moving.name, "migrating")
    pair.restart_master()
    assert "answered None" in pair.wait_for_event("stayed", process=moving.name).message


# --- launchers --------------------------------------------------------------------------------

KNOWS = ("sh", "-c", 'echo "knows ${IMAGER_KNOWS-no launcher}"; exec sleep 1000')


@pytest.mark.parametrize(
    ("strategy", "first"), [("imager", "nothing yet"), ("relaunch", "no launcher")]
)
def test_a_launcher_of_a_third_party_restores_from_its_image(
    make_cluster, third_party, strategy, first
) -> None:
    """The launcher starts processes whose strategy declares it, and restores any process."""
    cluster = make_cluster(host("h0"), migration=MigrationSettings({"imager": {}, "relaunch": {}}))

    def knows(said: str) -> None:
        row = cluster.wait("p", "running")
        wait_until(
            lambda: cluster.client.read_log("h0", "p", row.number, 0, 0).content == said, said
        )

    cluster.submit(service("p", *KNOWS, migration=MigrationPolicy(strategy)))
    knows(f"knows {first}\n".encode())
    cluster.client.checkpoint("p")
    cluster.wait("p", "checkpointed")
    cluster.client.restore("p")
    knows(b"knows what p#1 knew\n")
    cluster.cancel("p")


def test_a_launcher_that_cannot_be_used_is_named(cluster) -> None:
    """In the log of its host, and listed as failing if it is broken; the host works without it."""
    assert "launcher absent_launcher is absent: no container engine here" in cluster.log_of("h0")
    (row,) = [row for row in plugins(cluster) if (row.kind, row.host) == ("launcher", "h0")]
    assert (row.name, row.state) == ("broken_launcher", "failing")
    assert "an object with `prepare` is required" in row.reason
    assert cluster.run(job("launched", "true"))[0].state == "finished"


# --- at start ---------------------------------------------------------------------------------


def test_a_plugin_that_does_not_import_is_listed_as_broken(cluster) -> None:
    """The row names the missing module; everything else works."""
    broken = [row for row in cluster.client.list(plugins=True).plugins if row.state == "broken"]
    assert any("no_such_module_at_all" in row.reason for row in broken)


@pytest.mark.parametrize(
    ("part", "said"),
    [("master", ["wieghted", "weighted", "threshold"]), ("h0", ["memery", "memory"])],
)
def test_an_unknown_name_is_refused_at_start(make_cluster, part, said) -> None:
    """The error has the given and the allowed names; exit code 2, no traceback, no supervisor."""
    cluster = make_cluster(started=False, scoring=(ScoringChoice("wieghted"),))
    if part == "master":
        process = cluster.start_master().process
    else:
        process = cluster.start_slave(host("h0", probes={"memery": {}})).process
    assert process.wait(PATIENCE) == 2
    log = cluster.log_of(part)
    for word in said:
        assert word in log
    assert "Traceback" not in log
