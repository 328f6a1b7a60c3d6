"""Workload and variant files: all errors are reported at once, each at its place."""

from __future__ import annotations

import re
from dataclasses import fields
from math import inf
from pathlib import Path

import pytest

from rosrm.config.kinds import SIMULATION_KEYS
from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry
from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.values import Kind
from rosrm_simulate import workload_file as in_file
from rosrm_simulate.runs import run
from rosrm_simulate.variants import variant_in_text
from rosrm_simulate.workload import SimulatedLink
from rosrm_simulate.workload_file import load_workload

ROOT = Path(__file__).resolve().parents[4]
HOST = "hosts: [{name: a, memory: 1GiB, cpu: 2}]\n"
PROCESS = "processes: [{name: p, memory: 10MB}]\n"
BOTH = HOST + PROCESS


def of_process(keys: str) -> str:
    """Return a workload of one process with these keys."""
    return f"{HOST}processes: [{{name: p, {keys}}}]"


@pytest.fixture(scope="module")
def registry() -> Registry:
    return Registry.discover()


@pytest.fixture
def load(tmp_path, registry):
    def loaded(text: str, *changes: str, **options):
        (tmp_path / "w.yaml").write_text(text, encoding="utf-8")
        nodes = [variant_in_text(change) for change in changes]
        return load_workload(tmp_path / "w.yaml", registry, nodes, **options)

    return loaded


def test_a_workload_says_all_that_is_simulated(load):
    made = load(
        "hosts: [{name: 'h{i}', foreach: {i: 'range(0, 2)'}, memory: 1GiB, cpu: 2, disk: 5GB,"
        " limits: {memory: 0.5}, joins: 3s, leaves: 1min, lost: true, labels: {x: 1},"
        " devices: {gpu: [0]}}]\n"
        "processes:\n"
        "  - {name: j, memory: 10MB, growth: 1MB/s, most: 30MB, duration: 20s, cpu: 0.5,"
        " declares: [memory], needs: {cpu: 0.1}, migration: relaunch, arrives: 2s,"
        " devices: {gpu: 0.5}}\n"
        "  - {name: s, memory: 10MB}\n"
        "model: {start: 1s}\nuntil: 5min\nname: all of it\n"
    ).workload
    first, second = made.hosts
    assert (first.name, second.name) == ("h0", "h1")
    assert first.room("memory") == 2.0**29
    assert first.limits == {"memory": 0.5, "cpu": 0.9, "disk": 0.9}
    assert (first.joins, first.leaves, first.lost) == (3.0, 60.0, True)
    job, service = made.processes
    assert (job.spec.kind, service.spec.kind) == (Kind.JOB, Kind.SERVICE)
    assert job.spec.needs == {"memory": 1e7, "cpu": 0.1}
    assert job.spec.migration.strategy == "relaunch"
    assert (first.devices, job.spec.devices) == ((Device("gpu", "0"),), (DeviceNeed("gpu", 0.5),))
    assert [job.memory.at(age) for age in (0, 10, 25)] == [1e7, 2e7, 3e7]
    assert (service.duration, made.until, made.model.start) == (inf, 300.0, 1.0)


def test_a_workload_has_links_and_flows(load):
    made = load(
        "hosts: [{name: a, memory: 1GiB, cpu: 2, link: {rate: 5MB/s, round_trip: 20ms}}]\n"
        "processes: [{name: p, memory: 1MB, talks_to: {q: 1MB/s}}]\n"
    ).workload
    assert made.hosts[0].link == SimulatedLink(5e6, 0.02)
    assert made.processes[0].spec.talks_to == {"q": 1e6}


@pytest.mark.parametrize("rate", [".nan", "0", "fast", "-1", ".inf"])
def test_a_link_rate_that_is_no_positive_number_is_refused(load, rate):
    with pytest.raises(ConfigError, match=r"link\.rate: "):
        load(f"hosts: [{{name: a, memory: 1GiB, cpu: 2, link: {{rate: {rate}}}}}]\n{PROCESS}")


def test_what_is_drawn_lies_within_its_bounds_and_is_the_seeds(load):
    text = HOST + (
        "processes: [{name: 'p{i}', foreach: {i: 'range(0, 50)'}, memory: [8MB, 80MB],"
        " duration: [1s, 2s], arrives: [0s, 1min]}]\n"
    )
    one, again, other = load(text, seed=1), load(text, seed=1), load(text, seed=2)
    assert one.workload == again.workload != other.workload
    memory = [plan.memory.at(0.0) for plan in one.workload.processes]
    assert 8e6 <= min(memory) < 20e6 < 70e6 < max(memory) <= 80e6
    assert load(text + "seed: 2\n").workload.processes == other.workload.processes


def test_variants_say_their_own_word_over_the_settings(load):
    made = load(
        HOST + PROCESS + "cluster: {scoring: {policy: weighted, options: {weights: {cpu: 1}}},"
        " migration: {cooldown: 7s}}\nvariants: [{name: calm, migration: {automatic: false}}]\n",
        "scoring: {policy: threshold}", "hosts: 5",
    )  # fmt: skip
    base, calm, threshold, five = made.variants
    assert (base.name, calm.name) == ("as given", "calm")
    assert base.cluster.scoring[0].options == {"weights": {"cpu": 1.0}, "missing": "worst"}
    assert (calm.cluster.migration.automatic, calm.cluster.migration.cooldown) == (False, 7.0)
    assert calm.cluster.scoring == base.cluster.scoring
    assert (threshold.name, threshold.cluster.scoring[0].policy) == (
        "scoring.policy threshold", "threshold",
    )  # fmt: skip
    assert threshold.cluster.scoring[0].options["weights"] == {
        "memory": 1.0,
        "cpu": 0.5,
        "disk": 0.0,
    }
    assert (five.name, five.hosts) == ("hosts 5", 5)


def test_a_variant_may_chain_policies(load, registry):
    """A chain replaces a single policy and its options, and runs."""
    comparison = load(
        HOST + PROCESS + "cluster: {scoring: {policy: weighted, options: {missing: ignore}}}\n",
        "scoring: [{policy: weighted}, {policy: threshold, weight: 0.5}]",
    )
    _, chained = comparison.variants
    assert chained.cluster.chain == "weighted + 0.5 x threshold"
    assert chained.cluster.scoring[0].options["missing"] == "worst"
    assert run(comparison.workload, chained, registry).outcome.running == 1


@pytest.mark.parametrize(
    ("text", "place", "said"),
    [
        (BOTH + "host: 3", "3:1", "unknown key 'host'; did you mean 'hosts'?"),
        ("seed: 1\n" + PROCESS, "1:1", "hosts: a list of at least one host is required"),
        ("hosts: []\n" + PROCESS, "1:8", "hosts: a list of at least one host is required"),
        (HOST, "1:1", "processes: a list of at least one process is required"),
        (of_process("arrives: -1s"), "2:32", "arrives: '-1s' is not at least 0"),
        (of_process("duration: [9s, 2s]"), "2:33", "the lowest value is above"),
        (of_process("memory: [1MB]"), "2:31", "not one value or [lowest, high"),
        (of_process("memori: 1MB"), "2:23", "unknown key 'memori'; did you"),
        (of_process("memory: 1GB"), "2:31", "p: memory 1e+09 B is more than any host may give"),
        (of_process("needs: {disk: 1GB}"), "2:37", "p: disk 1e+09 B is more"),
        (HOST + "processes: [{name: p}, {name: p}]\n", "2:31", "duplicate process name 'p', first"),
        (of_process("foreach: {i: [1, 2]}"), "2:20", "every process the name 'p'"),
        (of_process("growth: 1MB/s"), "2:31", "p grows without a bound; set `most`"),
        (of_process("migration: move"), "2:34", "unknown migration strategy"),
        ("hosts: [{name: a, memory: 1GiB}]\n" + PROCESS, "1:9", "cpu: is missing"),
        ("hosts: [{name: a, memory: 0, cpu: 1}]\n" + PROCESS, "1:27", "memory: 0 is not greater"),
        ("hosts: [{name: a, memory: 1GB, cpu: 1, joins: 9s, leaves: 3s}]\n" + PROCESS, "1:59",
         "leaves (3 s) must be after joins (9 s)"),
        ("hosts: [{name: a, memory: 1GB, cpu: 1, limits: {gpu: 0.5}}]\n" + PROCESS, "1:49",
         "limits: unknown resource 'gpu'"),
        (BOTH + "until: -3s", "3:8", "until: '-3s' is not greater than 0"),
        (BOTH + "seed: x", "3:7", "seed: 'x' is not a whole number"),
        (BOTH + "model: {period: 0}", "3:17", "model: period: 0 is not within 0.01..10"),
        (BOTH + "cluster: {scoring: {policy: wieghted}}", "3:21",
         "unknown scoring policy 'wieghted'; did you mean 'weighted'?"),
        (BOTH + "cluster: {journal: {sync: full}}", "3:11", "unknown key 'journal' in clus"),
        (BOTH + "variants: [{hosts: 0}]", "3:20", "hosts: 0 is not"),
        (BOTH + "variants: [7]", "3:12", "a variant is a mapping"),
        (BOTH + "variants: [{queue: {backfil: true}}]", "3:21", "unknown key 'backfil'"),
        (BOTH + "variants: [{hosts: 2}, {hosts: 2}]", "3:24", "two variants are called"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_at_its_place(load, text, place, said):
    with pytest.raises(ConfigError) as raised:
        load(text)
    assert f"w.yaml:{place}: " in str(raised.value), raised.value
    assert said in str(raised.value)


def test_all_that_is_wrong_is_said_at_once(load):
    with pytest.raises(ConfigError, match="4 errors in") as raised:
        load("hosts: [{name: a, memory: -1, cpu: 1}]\nprocesses: [{name: ' '}]\nx: 1\nuntil: 0\n")
    assert raised.value.exit_code == 2


@pytest.mark.parametrize("path", sorted((ROOT / "examples" / "simulation").glob("*.yaml")), ids=str)
def test_every_example_loads(path, registry):
    assert load_workload(path, registry).workload.processes


def test_the_workload_in_the_how_to_shows_differences(load, registry):
    """Each row of its table differs from the others in the compared values."""
    text = (ROOT / "docs" / "how-to" / "simulate.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"<!-- workload -->\n```yaml[^\n]*\n(.*?)```", text, re.DOTALL)
    made = load(block)
    assert [one.name for one in made.variants] == [
        "as given", "by CPU alone", "without moves", "hosts 4",
    ]  # fmt: skip
    outcomes = [run(made.workload, one, registry).outcome for one in made.variants]
    rows = [(one.migrations, one.over_limit, one.imbalance["memory"]) for one in outcomes]
    assert len(set(rows)) == len(rows)
    given, _, without_moves, _ = outcomes
    assert given.migrations > without_moves.migrations == 0
    assert given.over_limit < without_moves.over_limit


@pytest.mark.parametrize(
    ("heading", "names"),
    [
        ("## The workload", SIMULATION_KEYS),
        ("### A host", [f.name for f in fields(in_file.HostInFile)]),
        ("### A process", [f.name for f in fields(in_file.ProcessPlanInFile)]),
        ("### The model", [f.name for f in fields(in_file.ModelInFile)]),
    ],
)
def test_every_key_is_documented_and_nothing_else(heading, names):
    text = (ROOT / "docs" / "reference" / "simulation.md").read_text(encoding="utf-8")
    behind = text.split(f"{heading}\n", 1)[1]
    section = re.split(r"^#{2,3} ", behind, maxsplit=1, flags=re.MULTILINE)[0]
    first = re.findall(r"^\| (`[^|]*`) \|", section, re.MULTILINE)
    assert {word for cell in first for word in re.findall(r"`(\w+)`", cell)} == set(names)


def test_variants_are_judged_beside_a_wrong_workload(load):
    """The message lists all errors at once: those of the file and of each variant."""
    variants = ["scoring: {policy: wieghted}", "queue: {backfil: true}",
                "scoring: {policy: treshold}"]  # fmt: skip
    with pytest.raises(ConfigError) as raised:
        load(BOTH + "seed: x", *variants)
    for said in ("seed: 'x'", "policy 'wieghted'", "key 'backfil'", "policy 'treshold'"):
        assert said in str(raised.value)
