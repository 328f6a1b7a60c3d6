"""`cluster.yaml`: every setting is read, and every error has its place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import pytest
from annotated_types import Le

from rosrm.config.cluster import load_cluster
from rosrm.config.settings import ClusterConfig, ScoringChoice
from rosrm.core.master.settings import CoreSettings
from rosrm.extensions.contracts import MigrationOffer, ProbeOffer, ScoringOffer
from rosrm.extensions.registry import Registry
from rosrm.extensions.units import Fraction, ResourceName, Seconds
from tests.plugin_kit import registry_of


@dataclass(frozen=True)
class Steady:
    """One variant of an option."""

    value: float = 1.0


@dataclass(frozen=True)
class Rising:
    """Another variant."""

    slope: float = 1.0


@dataclass(frozen=True)
class Curves:
    """Options of another scoring policy."""

    curve: Steady | Rising = Steady()


@dataclass(frozen=True)
class Weights:
    """Options of a scoring policy."""

    mem: Fraction = 1.0
    cpu: Annotated[float, Le(0.5)] = 0.0
    window: Seconds = 1.0
    order: tuple[str, ...] = ()


class Made:
    """Policy that the offer makes."""

    def __init__(self, options):
        self.score = options


RELAUNCH = MigrationOffer("relaunch", lambda options: options)


@pytest.fixture
def registry():
    weighted = ScoringOffer("weighted", Made, Weights)
    return registry_of(weighted, ScoringOffer("curved", Made, Curves), RELAUNCH)


def test_an_empty_file_gives_the_defaults(file):
    assert load_cluster(file("")) == ClusterConfig()
    assert ClusterConfig().core() == CoreSettings()


def test_every_setting_is_read(file, tmp_path):
    config = load_cluster(
        file(
            """
            name: lab
            ros:
              domain: 7
              discovery: {range: localhost, server: "10.0.0.1:11811"}
              transports: UDPv4
              namespace: /fleet/rosrm
              interface: wg0
            security: none
            state: here
            scoring: {policy: threshold, options: {a: 1}}
            migration:
              strategies: {relaunch: , handoff: {x: 2}}
              cooldown: 1min
              hysteresis: 500ms
              headroom: 0.1
              max_in_flight: 3
              automatic: false
            queue: {backfill: true}
            quotas: {default: {processes: 50, memory: 64GB, cpu: 32}, ada@desk: {cpu: 1.5 cores}}
            defaults: {needs: {memory: 1GiB, cpu: 1}, settle: 5s}
            liveness: {suspect: 2s, lease: 20s}
            control: {max_age: 3s, beat_period: 100ms, order_retry: 1s}
            journal: {sync: full, keep_events: 10, keep_ended: 20}
            checkpoint: {policy: often, options: {b: 2}}
            delivery_timeout: 4s
            """
        )
    )
    assert (config.name, config.state) == ("lab", tmp_path / "here")
    assert (config.ros.domain, config.ros.discovery_range) == (7, "localhost")
    assert (config.ros.discovery_server, config.ros.transports) == ("10.0.0.1:11811", "UDPv4")
    assert (config.ros.namespace, config.ros.interface) == ("/fleet/rosrm", "wg0")
    assert config.security == "none"
    assert config.scoring == (ScoringChoice("threshold", 1.0, {"a": 1}),)
    assert dict(config.migration.strategies) == {"relaunch": {}, "handoff": {"x": 2}}
    assert config.core() == CoreSettings(
        backfill=True,
        default_needs={"memory": 2.0**30, "cpu": 1.0},
        settle=5.0,
        suspect=2.0,
        lease=20.0,
        delivery_timeout=4.0,
        cooldown=60.0,
        hysteresis=0.5,
        headroom=0.1,
        max_migrations=3,
        automatic=False,
        order_retry=1.0,
        keep_ended=20,
        quotas={
            "default": {"processes": 50, "memory": 64e9, "cpu": 32.0},
            "user:ada@desk": {"cpu": 1.5},
        },
    )
    assert (config.control.max_age, config.control.beat_period) == (3.0, 0.1)
    assert (config.journal.sync, config.journal.keep_events) == ("full", 10)
    assert (config.checkpoint.policy, config.checkpoint.options) == ("often", {"b": 2})
    assert ClusterConfig.from_json(config.to_json()) == config


def test_every_error_is_reported_at_once_with_its_place(refusal):
    said = refusal(
        load_cluster,
        """
        name: "two words"
        scorring: {policy: x}
        ros: {domain: 300, discovery: {range: local}}
        migration: {headroom: 5, automatic: yes, strategies: [a, a]}
        liveness: {suspect: 20s}
        journal:
        queue: []
        defaults: {needs: {cpu: 5MB}}
        """,
    )
    expected = [
        "f.yaml:2:7: 'two words' cannot be the name of a cluster",
        "f.yaml:3:1: unknown key 'scorring'; did you mean 'scoring'? Allowed: name, ros",
        "f.yaml:4:15: ros.domain: 300 is not within 0..232",
        """f.yaml:4:39: ros.discovery.range: "local" is unknown; did you mean 'localhost'?""",
        "f.yaml:5:23: migration.headroom: 5 is not within 0..1 (a fraction: 0.8 means 80 %)",
        'f.yaml:5:37: migration.automatic: true or false is required, not "yes"',
        "f.yaml:5:54: migration.strategies: 'a' is named twice",
        "f.yaml:6:21: liveness.suspect (20 s) must be less than liveness.lease (10 s)",
        "f.yaml:7:9: journal: a mapping is required, not nothing (null)",
        "f.yaml:8:8: queue: a mapping is required, not a list",
        "f.yaml:9:25: defaults.needs.cpu: unknown unit 'MB'. Allowed: core, cores",
    ]
    lines = said.splitlines()
    assert lines[0] == f"{len(expected)} errors in f.yaml"
    for line, start in zip(lines[1:], expected, strict=True):
        assert line.strip().startswith(start)
    assert f"{expected[7]}\n" in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{ada: {procesess: 1}}",
         "1:16: unknown key 'procesess' in quotas.ada; did you mean 'processes'? Allowed: "),
        ("{ada: {processes: -1}}", "1:27: quotas.ada.processes: -1 is not within 0..2147483647"),
        ("{ada: {processes: 1.5}}", "1:27: quotas.ada.processes: 1.5 is not a whole number"),
        ("{ada: {memory: 5 cores}}",
         "1:24: quotas.ada.memory: unknown unit 'cores'. Allowed: B, kB, KB,"),
        ("{ada: {cpu: .inf}}", "1:21: quotas.ada.cpu:"),
        ("{ada: 5}", "1:15: quotas.ada: a mapping is required, not 5"),
        ("{'a b': {cpu: 1}}", "1:10: quotas: 'a b' is no name of a user; for user:ada write ada"),
        ("{'user:ada': {cpu: 1}}", "1:10: quotas: 'user:ada' is no name of a user;"),
        ("[ada]", "1:9: quotas: a mapping is required, not a list"),
    ],
)  # fmt: skip
def test_a_wrong_quota_is_refused_with_its_place(refusal, text, said):
    assert refusal(load_cluster, f"quotas: {text}").startswith(f"f.yaml:{said}")


@pytest.mark.parametrize(
    ("text", "place", "period", "suspect"),
    [
        ("liveness:\n  suspect: 500ms\n", "2:12", "0.2", "0.5"),
        ("control:\n  beat_period: 1s\n", "2:16", "1", "1"),
        ("liveness: {suspect: 2s}\ncontrol:\n  beat_period: 700ms\n", "3:16", "0.7", "2"),
    ],
)
def test_a_quiet_slave_is_not_taken_for_a_silent_one(refusal, text, place, period, suspect):
    """An idle slave sends one message per beat period, and one message may be lost."""
    assert refusal(load_cluster, text) == (
        f"f.yaml:{place}: control.beat_period ({period} s) must be at most a third of "
        f"liveness.suspect ({suspect} s): a slave without changes reports once in a beat "
        f"period"
    )


def test_a_suspicion_of_just_three_beat_periods_is_taken(file):
    assert load_cluster(file("liveness: {suspect: 600ms}")).liveness.suspect == 0.6


def test_a_wrong_type_and_an_unknown_plugin_are_reported_together(refusal, registry):
    said = refusal(load_cluster, "name: 5\nscoring: {policy: wieghted}\n", registry)
    assert "f.yaml:1:7: name: text is required, not 5" in said
    unknown = "f.yaml:2:11: unknown scoring policy 'wieghted'; did you mean 'weighted'?"
    assert f"{unknown} Installed: curved, weighted." in said


def test_options_are_checked_against_the_plugin_and_kept_in_base_units(file, registry):
    config = load_cluster(
        file("scoring: {options: {mem: 0.5, window: 2min, order: [a]}}"), registry
    )
    (scoring,) = config.scoring
    assert scoring.policy == "weighted"
    assert scoring.options == {"mem": 0.5, "cpu": 0.0, "window": 120.0, "order": ["a"]}
    assert registry.scoring("weighted", scoring.options).score == Weights(0.5, 0.0, 120.0, ("a",))


def test_a_wrong_option_names_plugin_option_allowed_ones_and_place(refusal, registry):
    said = refusal(load_cluster, "scoring: {options: {mem: 1.5, cpu: 0.6, memory: 1}}", registry)
    title = "options of scoring policy 'weighted'"
    assert f"f.yaml:1:26: {title}: mem: 1.5 is not within 0..1" in said
    assert f"f.yaml:1:36: {title}: cpu: 0.6 is not at most 0.5" in said
    assert f"f.yaml:1:41: unknown key 'memory' in {title}; did you mean 'mem'?" in said
    assert "Allowed: mem, cpu, window, order" in said


@pytest.mark.parametrize(
    ("curve", "fault"),
    [
        ("{slop: 1}", "unknown key 'slop' in {}; did you mean 'slope'? Allowed: value, slope"),
        ("{slope: steep}", '{}.slope: a number is required, not "steep"'),
        ("5", "{}: a mapping is required, not 5"),
    ],
)
def test_a_fault_in_an_option_of_several_types_is_reported_once(refusal, registry, curve, fault):
    """The error has its path in the file and the keys of all types."""
    text = f"scoring: {{policy: curved, options: {{curve: {curve}}}}}"
    said = refusal(load_cluster, text, registry)
    assert said.endswith(fault.format("options of scoring policy 'curved': curve"))
    assert said.count("options of") == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("checkpoint: {policy: null, options: {a: 1}}",
         "f.yaml:1:37: checkpoint.options: options of no policy"),
        ("migration: {strategies: {relaunch: {fast: true}}}",
         "unknown key 'fast' in options of migration strategy 'relaunch'. Allowed: none"),
        ("scoring: {options: [1]}",
         "f.yaml:1:20: scoring.options: a mapping is required, not a list"),
    ],
)  # fmt: skip
def test_options_that_nothing_takes_are_refused(refusal, registry, text, said):
    assert said in refusal(load_cluster, text, registry)


def test_one_policy_and_a_list_of_one_are_the_same(file, registry):
    """The single form stays valid, and is a chain of one link with the weight 1."""
    single = load_cluster(file("scoring: {policy: weighted, options: {mem: 0.5}}"), registry)
    listed = load_cluster(file("scoring: [{policy: weighted, options: {mem: 0.5}}]"), registry)
    assert single.scoring == listed.scoring
    assert ClusterConfig.from_json(single.to_json()).scoring == single.scoring


def test_a_chain_has_weights_and_options_for_each_policy(file, registry):
    config = load_cluster(
        file(
            """
            scoring:
              - {policy: weighted, options: {mem: 0.5}}
              - {policy: curved, weight: 0.5}
            """
        ),
        registry,
    )
    assert config.chain == "weighted + 0.5 x curved"
    assert [one.weight for one in config.scoring] == [1.0, 0.5]
    assert config.scoring[0].options["mem"] == 0.5
    assert ClusterConfig.from_json(config.to_json()).scoring == config.scoring


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scoring: []", "1:10: scoring: at least one policy is required; or omit the key"),
        ("scoring: [{policy: curved}, {policy: weighted}, {policy: curved}]",
         "1:58: scoring: 'curved' is in the chain already; give it once, with one weight"),
        ("scoring: [{policy: curved}, {policy: curvd}]",
         "1:30: unknown scoring policy 'curvd'; did you mean 'curved'?"),
        ("scoring: [{policy: curved, weight: -1}]", "1:36: scoring[0].weight: -1 is not within"),
        ("scoring: [{policy: curved, weight: .nan}]", "1:36: scoring[0].weight: "),
        ("scoring: {policy: curved, weight: heavy}", "1:35: scoring.weight: 'heavy' is not"),
        ("scoring: [weighted]", "1:11: scoring[0]: a mapping is required, not \"weighted\""),
        ("scoring: weighted", "1:10: scoring: a mapping is required, not \"weighted\""),
        ("scoring: [{policy: curved, options: {wrong: 1}}]", "unknown key 'wrong' in options of"),
        ("scoring: [{polcy: curved}]", "1:12: unknown key 'polcy' in scoring[0]"),
        ("filters: [racks]", "1:11: unknown filter 'racks'. None is installed"),
        ("filters: {racks: {a: 1}}", "1:11: unknown filter 'racks'. None is installed"),
        ("filters: racks", "1:10: filters: a mapping is required, not \"racks\""),
    ],
)  # fmt: skip
def test_a_wrong_chain_or_filter_is_refused_with_its_place(refusal, registry, text, said):
    assert said in refusal(load_cluster, text, registry)


def test_a_default_plugin_that_is_not_installed_is_reported(refusal):
    said = refusal(load_cluster, "", Registry.of())
    assert "unknown scoring policy 'weighted'. None is installed; rosrm-scoring has" in said
    assert "unknown migration strategy 'relaunch'" in said


@dataclass(frozen=True)
class ByResource:
    """Options that name resources."""

    weights: Mapping[ResourceName, float] = field(default_factory=dict)
    watch: tuple[ResourceName, ...] = ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scoring: {policy: w, options: {weights: {memroy: 1.0}}}",
         "weights: unknown resource 'memroy'; did you mean 'memory'? Allowed: memory (resources"),
        ("scoring: {policy: w, options: {watch: [memory, dsk]}}",
         "f.yaml:1:48: options of scoring policy 'w': watch: unknown resource 'dsk'. Allowed"),
        ("scoring: {policy: w}\ndefaults: {needs: {memroy: 1MB}}", "2:20: defaults.needs: unknown"),
    ],
)  # fmt: skip
def test_a_resource_that_no_probe_reads_is_refused(refusal, text, said):
    """Both options marked to name resources and assumed needs are checked."""
    memory = ProbeOffer("memory", lambda options, context: None)
    scoring = ScoringOffer("w", lambda options: options, ByResource)
    assert said in refusal(load_cluster, text, registry_of(memory, scoring, RELAUNCH))


def test_no_text_is_among_the_allowed_words_where_it_is_one(refusal):
    said = refusal(load_cluster, "ros: {discovery: {range: lokalhost}}")
    assert "did you mean 'localhost'? Allowed: \"\", " in said


# --- defaults.process -------------------------------------------------------------------------


def test_defaults_of_processes_have_the_keys_and_shorthands_of_a_work_file(file):
    """The paths of the given keys tell the master which defaults there are."""
    config = load_cluster(
        file("""\
            defaults:
              process:
                migration: {strategy: relaunch, overlap: false}
                restart: always
                host_loss: elsewhere
                needs: {memory: 200MB}
                labels: {avoided: {gpu: "yes"}}
                environment: {OMP_NUM_THREADS: 1}
                stop: {interrupt_grace: 2s}
            """)
    )
    process = ClusterConfig.from_json(config.to_json()).core().process_defaults
    assert (process.migration.strategy, process.migration.overlap) == ("relaunch", False)
    assert (process.restart.when, process.host_loss.then) == ("always", "elsewhere")
    assert (process.needs, process.avoided_labels) == ({"memory": 2e8}, {"gpu": "yes"})
    assert process.environment == {"OMP_NUM_THREADS": "1"}
    assert {"restart.when", "stop.interrupt_grace", "migration.overlap"} <= set(process.given)
    assert "stop.terminate_grace" not in process.given


@pytest.mark.parametrize("text", ["", "defaults: {process: }", "defaults: {process: {}}"])
def test_without_defaults_of_processes_there_are_none(file, text):
    assert load_cluster(file(text)).core().process_defaults is None


@pytest.mark.parametrize(
    ("process", "fault"),
    [
        ("{name: p}", "f.yaml:1:22: defaults.process: name is allowed in a process only"),
        ("{module: m}", "f.yaml:1:22: defaults.process: module is allowed in a process only"),
        ("{foreach: {i: [1]}}", "defaults.process: foreach is allowed in a process only"),
        ("{spread: rack}", "defaults.process: spread is allowed in a process only"),
        ("{restrat: always}", "f.yaml:1:22: unknown key 'restrat'; did you mean 'restart'?"),
        ("{restart: {delay: soon}}", "f.yaml:1:39: restart.delay: "),
        ("{restart: {delay: 9s, max_delay: 2s}}", "restart.max_delay must not be less than"),
        ("{needs: {memory: 2cores}}", "f.yaml:1:38: needs.memory: "),
        ("[restart]", "f.yaml:1:21: defaults.process: a mapping is required"),
        ("always", "f.yaml:1:21: defaults.process: a mapping is required"),
        ("{standby: true}", "f.yaml:1:31: "),
        (
            "{migration: criu}",
            "f.yaml:1:33: defaults.process: migration strategy 'criu' is not selected",
        ),
    ],
)
def test_wrong_defaults_of_processes_have_their_place(refusal, process, fault):
    assert fault in refusal(load_cluster, f"defaults: {{process: {process}}}")


@pytest.mark.parametrize("given", ["maybe", "true"])
def test_the_allowed_kinds_of_preemption_are_named_as_a_file_has_them(refusal, given):
    """One of them is a boolean."""
    said = refusal(load_cluster, f"queue: {{preemption: {given}}}")
    assert "1:21: queue.preemption: " in said
    assert said.rstrip().endswith("is unknown. Allowed: move, requeue, false")


def test_preemption_can_be_switched_off(tmp_path):
    """A boolean, and not the text."""
    path = tmp_path / "c.yaml"
    path.write_text("queue: {preemption: false}\n")
    config = load_cluster(path)
    assert config.core().preemption is False
    assert ClusterConfig.from_json(config.to_json()).queue.preemption is False
