"""Registry of plugins: choice by name, and a named reason for each failure."""

from __future__ import annotations

import inspect
import re
import threading
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from rosrm.config.settings import DEFAULT_LIMITS
from rosrm.errors import ConfigError, PluginError, SkipPlugin
from rosrm.extensions.contracts import (
    CheckpointOffer,
    FilterOffer,
    MigrationOffer,
    ProbeContext,
    ProbeOffer,
    ScoringOffer,
)
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.made import FailedProbe, Probes
from rosrm.extensions.placement import SelectedFilter
from rosrm.extensions.registry import Registry
from rosrm.model.values import Reading, ResourceDescription
from tests.plugin_kit import plugin, registry_of


@dataclass(frozen=True)
class Options:
    """Options of a plugin."""

    ratio: float = 0.5
    score = propose = choose = mask = reason = None


class Probe:
    """Probe without a reading."""

    def __init__(self, *names, capacity=1.0):
        self.resources = [ResourceDescription(name, "1", capacity) for name in names]
        self.closed = False

    def read(self):
        return [Reading(resource.name, 0.0) for resource in self.resources]

    def close(self):
        self.closed = True


def offered(name, create=None, **more):
    return ProbeOffer(name, create or (lambda options, context: Probe(name)), **more)


def failed(result: Probes) -> dict[str, str]:
    """Return the probes that could not be made, with the reasons."""
    return {one.name: one.probe.reason for one in result.made if isinstance(one.probe, FailedProbe)}


@pytest.fixture
def context(tmp_path):
    return ProbeContext("machine", {}, tmp_path, SimpleNamespace())


def test_each_kind_is_made_by_name_with_its_options():
    registry = registry_of(
        ScoringOffer("s", lambda options: options, Options),
        MigrationOffer("m", lambda options: options, Options),
        CheckpointOffer("c", lambda options: options, Options),
        FilterOffer("f", lambda options: options, Options, reads=("name",), permanent=True),
    )
    assert registry.scoring("s", {"ratio": 1}) == Options(1.0)
    assert registry.filters({"f": {"ratio": 1}}) == (
        SelectedFilter("f", Options(1.0), permanent=True, reads=("name",)),
    )
    assert registry.migrations({"m": {}}) == {"m": Options()}
    assert registry.checkpoint("c") == Options()
    assert registry.checkpoint(None) is None
    kinds = ("checkpoint", "filter", "migration", "scoring")
    assert [(row.kind, row.state) for row in registry.rows()] == [(k, "selected") for k in kinds]


def test_an_unknown_name_is_refused_with_what_is_there_and_what_is_broken():
    registry = Registry.of(
        good=plugin(ScoringOffer("weighted", lambda options: None)),
        bad=plugin(register_scoring_policies=OSError("no such table")),
    )
    with pytest.raises(ConfigError) as refused:
        registry.scoring("bad")
    said = str(refused.value)
    assert "unknown scoring policy 'bad'. Installed: weighted." in said
    assert "Broken: plugin 'bad': register_scoring_policies (" in said
    assert "failed with OSError: no such table" in said


def test_of_broken_plugins_only_the_selected_one_is_reported():
    """The plugin is found by the name of its offer or its own; others are only counted.

    If no plugin certainly matches, the error names those that broke before they offered a name.
    """
    nameless = plugin(register_scoring_policies=OSError("no such table"))
    bare = ScoringOffer("s", lambda options: None, options=dict)
    registry = Registry.of(rosrm_rack=nameless, other=nameless, third=plugin(bare))
    with pytest.raises(ConfigError) as refused:
        registry.scoring("rack")
    assert "Broken: plugin 'rosrm_rack': " in str(refused.value)
    assert str(refused.value).endswith("2 plugins are broken besides: see `rosrm plugins --local`.")
    assert "'other'" not in str(refused.value)
    with pytest.raises(ConfigError, match=r"Broken: plugin 'third': .* `options` is not a datacla"):
        registry.scoring("s")
    with pytest.raises(ConfigError) as refused:
        registry.scoring("weighted")
    assert "Broken: plugin 'rosrm_rack': register_scoring_policies (" in str(refused.value)
    assert "plugin 'other': register_scoring_policies (" in str(refused.value)
    assert str(refused.value).endswith("1 plugin is broken besides: see `rosrm plugins --local`.")


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (None, "made None; an object with `score` is required (does it lack a `return`?)"),
        (SimpleNamespace(scores=1), "which has no `score`; is its `scores` misspelt?"),
        (SimpleNamespace(), "made a SimpleNamespace, which has no `score`"),
    ],
)
def test_what_lacks_its_method_is_refused_when_it_is_made(made, said):
    """The refusal comes at the start, not at the first decision."""
    offer = ScoringOffer("s", lambda options: made)
    registry = registry_of(offer)
    with pytest.raises(PluginError) as refused:
        registry.scoring("s")
    assert said in str(refused.value)
    assert "test_registry.py:" in str(refused.value)


@pytest.mark.parametrize(
    ("reads", "said"),
    [
        (("nmae",), "`reads` has no field 'nmae'; did you mean 'name'? Allowed: name, node_name"),
        ("name", "`reads` is 'name'; a tuple of field names is required"),
        (None, "`reads` is None; a tuple"),
    ],
)
def test_fields_that_a_spec_lacks_cannot_be_declared(reads, said):
    """The offer is broken, and is reported when plugins are loaded."""
    offer = ScoringOffer("s", lambda options: None, reads=reads)
    (broken,) = registry_of(offer).broken
    assert said in broken.reason
    assert broken.name == "s"


@pytest.mark.parametrize(
    ("described", "said"),
    [
        (ResourceDescription("a", None, 1.0), "gives 'a' the unit None; text is required"),
        (ResourceDescription("a", "B", 1.0, None), "gives 'a' the scope None; text is required"),
        (ResourceDescription("Open Files", "1", 1.0), "names a resource 'Open Files'. Allowed"),
        (ResourceDescription(3, "1", 1.0), "names a resource 3"),
        (ResourceDescription("a", "B", "10"), "gives 'a' a capacity of '10'; a number above 0"),
        ("a", "describes a resource by 'a', which is not a ResourceDescription"),
    ],
)
def test_a_resource_that_no_message_can_carry_is_refused(context, described, said):
    """The probe fails with its class and place, and the others are made."""
    probe = Probe("a")
    probe.resources = [described]
    result = registry_of(offered("a", lambda options, context: probe)).probes({"a": {}}, context)
    assert result.absent == {}
    assert f"Probe ({__file__}:{inspect.getsourcelines(Probe)[1]}) {said}" in failed(result)["a"]


def test_a_probe_reads_only_what_its_offer_declares(context):
    """Names of resources in a file can thus be checked before any probe is made."""
    registry = registry_of(offered("fds", lambda options, context: Probe("files")))
    reason = failed(registry.probes({"fds": {}}, context))["fds"]
    assert "which its offer does not declare: write ProbeOffer(..., resources=(" in reason
    assert registry.resources() == ("fds",)


def test_a_wrong_option_is_refused_with_what_is_allowed():
    registry = registry_of(ScoringOffer("s", lambda options: None, Options))
    with pytest.raises(ConfigError, match=r"options of scoring policy 's': unknown a; allowed: ra"):
        registry.scoring("s", {"a": 1})
    with pytest.raises(ConfigError, match=r"ratio: float is required, not 'x'"):
        registry.scoring("s", {"ratio": "x"})


def test_a_plugin_that_raises_when_it_is_made_is_named_with_its_definition():
    def create(options):
        return {}["weight"]

    registry = registry_of(ScoringOffer("s", create))
    with pytest.raises(PluginError) as refused:
        registry.scoring("s")
    said = str(refused.value)
    assert said.startswith("scoring policy 's' of plugin 'ours': `create` (")
    assert "test_registry.py:" in said
    line = create.__code__.co_firstlineno + 1
    assert said.endswith(f"raised KeyError: 'weight' ({__file__}:{line})")
    assert registry.rows("scoring")[0].state == "broken"


def test_a_policy_that_is_absent_is_refused_with_its_reason():
    def create(options):
        raise SkipPlugin("no licence")

    registry = registry_of(ScoringOffer("s", create))
    with pytest.raises(ConfigError, match="scoring policy 's' is absent here: no licence"):
        registry.scoring("s")


def test_a_name_offered_twice_belongs_to_neither_and_both_are_named():
    registry = Registry.of(
        a=plugin(ScoringOffer("s", lambda options: 1)),
        b=plugin(ScoringOffer("s", lambda options: 2)),
    )
    with pytest.raises(ConfigError, match="offered by plugin 'a' and plugin 'b': uninstall"):
        registry.scoring("s")
    assert {row.state for row in registry.rows()} == {"broken"}


def test_a_name_that_one_plugin_offers_twice_is_to_be_renamed():
    """Nothing can be uninstalled, so the remedy is another name."""
    twice = plugin(ScoringOffer("s", lambda options: 1), ScoringOffer("s", lambda options: 2))
    with pytest.raises(ConfigError, match="offered 2 times by plugin 'a': rename all but one"):
        Registry.of(a=twice).scoring("s")


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (5, "returned int, not a list of ProbeOffer"),
        ("cpu", "returned str, not a list of ProbeOffer"),
        ([ScoringOffer("s", lambda options: None)], "which is not a ProbeOffer"),
        ([ProbeOffer("", Probe)], "offers something without a name: ''"),
        ([ProbeOffer("PG flow!", Probe)], "offers the name 'PG flow!'; allowed: at most 64"),
        ([ProbeOffer("p", None)], "'p': `create` cannot be called"),
        ([ProbeOffer("p", Probe, options=dict)], "'p': `options` is not a dataclass"),
        ([ProbeOffer("p", Probe, options=Reading)], "'p': option 'resource' has no default"),
        (SystemExit(1), "failed with SystemExit: 1"),
        (ValueError("x"), "failed with ValueError: x"),
        (None, "returned None, not a list of ProbeOffer"),
    ],
)
def test_a_hook_that_answers_nonsense_is_broken_and_the_others_go_on(answer, said):
    registry = Registry.of(bad=plugin(register_probes=answer), good=plugin(offered("fine")))
    assert registry.names("probe") == ("fine",)
    (broken,) = registry.broken
    assert said in broken.reason
    assert "register_probes (" in broken.reason


@hookimpl
def register_probe():
    return []


@hookimpl
def register_probes(config):
    return []


MISSPELT = (
    r"^unknown hook 'register_probe' \(.*did you mean 'register_probes'\? "
    r"Allowed: register_probes, register_sc"
)
SURPLUS = "TypeError: it has the parameters config; a hook has none"


@pytest.mark.parametrize(
    ("name", "hook", "said"),
    [
        ("register_probe", register_probe, MISSPELT),
        ("register_probes", list, "lacks the mark @hookimpl"),
        ("register_probes", register_probes, SURPLUS),
    ],
    ids=["misspelt", "without its mark", "with an argument that it does not get"],
)
def test_a_wrong_hook_is_reported(name, hook, said):
    (broken,) = Registry.of(ours=SimpleNamespace(**{name: hook})).broken
    assert re.search(said, broken.reason)


def test_only_a_probe_that_raises_skip_is_absent(context):
    """The resources of a failed probe count as read without success, never as absent."""

    def skip(options, context):
        raise SkipPlugin("no NVIDIA driver")

    def fail(options, context):
        raise OSError("no /proc")

    registry = registry_of(offered("cpu"), offered("gpu", skip), offered("net", fail))
    result = registry.probes({"cpu": {}, "gpu": {}, "net": {}}, context)
    assert result.absent == {"gpu": "no NVIDIA driver"}
    cpu, net = result.made
    assert (cpu.name, isinstance(cpu.probe, FailedProbe)) == ("cpu", False)
    assert (net.name, [one.name for one in net.resources]) == ("net", ["net"])
    line = fail.__code__.co_firstlineno + 1
    said = rf"^plugin 'ours': .* raised OSError: no /proc \({__file__}:{line}\)$"
    with pytest.raises(PluginError, match=said):
        net.probe.read()
    states = {row.name: row.state for row in registry.rows("probe", host="h")}
    assert states == {"cpu": "selected", "gpu": "absent", "net": "broken"}


def test_the_default_probes_are_those_that_say_so(context):
    registry = registry_of(offered("cpu", default=True, period=0.5, deadline=2.0), offered("other"))
    (made,) = registry.probes(None, context).made
    assert (made.name, made.period, made.deadline) == ("cpu", 0.5, 2.0)
    assert registry.probes({}, context).made == ()


def test_a_host_without_any_probe_must_say_so(context):
    with pytest.raises(ConfigError, match=r"no probe is installed.*rosrm-resources.*probes: \{\}"):
        Registry.of().probes(None, context)


def broken_plugin() -> SimpleNamespace:
    def register_probes():
        raise ImportError("libnvml.so.1: cannot open shared object file")

    return SimpleNamespace(register_probes=hookimpl(register_probes))


@pytest.mark.parametrize("others", [{}, {"net": plugin(offered("net", default=True))}])
def test_a_broken_plugin_leaves_no_host_unmeasured(context, others):
    """Its default probes are not known, so the host runs, says why, and gets no work."""
    registry = Registry.of(ours=broken_plugin(), **others)
    (lost,) = (one for one in registry.probes(None, context).made if one.name != "net")
    assert sorted(one.name for one in lost.resources) == sorted(DEFAULT_LIMITS)
    with pytest.raises(PluginError, match=r"libnvml\.so\.1"):
        lost.probe.read()
    assert [row.state for row in registry.rows("probe") if row.name == lost.name] == ["broken"]
    assert len(registry.probes(None, context).made) == 1 + len(others)


def test_a_broken_plugin_beside_the_probes_of_all_limits_is_no_probe(context):
    probes = offered("all", default=True, resources=tuple(DEFAULT_LIMITS))
    registry = Registry.of(ours=broken_plugin(), good=plugin(probes))
    assert list(registry.chosen_probes(None)) == ["all"]


def test_an_unknown_probe_stops_the_slave_at_its_start(context):
    with pytest.raises(ConfigError, match="unknown probe 'cqu'; did you mean 'cpu'"):
        registry_of(offered("cpu")).probes({"cqu": {}}, context)


NOTHING = ResourceDescription("b", "1", 0.0)
UNCLOSABLE = SimpleNamespace(resources=[NOTHING], read=None, close=None)  # None() raises


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (Probe("a"), "reads 'a', as 'first' does already"),
        (Probe("b", capacity=0.0), "gives 'b' a capacity of 0.0; a number above 0"),
        (Probe("b", capacity=float("nan")), "gives 'b' a capacity of nan"),
        (Probe(*(f"r{i}" for i in range(16))), "exceeds the 16 resources"),
        (Probe(), "describes no resource; raise SkipPlugin in `create`"),
        (SimpleNamespace(), "made a SimpleNamespace, which has no `resources`"),
        (UNCLOSABLE, "gives 'b' a capacity of 0.0; a number above 0"),
    ],
)
def test_a_probe_whose_resources_cannot_be_taken_is_closed_and_fails(context, second, said):
    """A stand-in has the declared resources that no other probe reads, up to 16."""
    registry = registry_of(
        offered("first", lambda options, context: Probe("a"), resources=("a",)),
        offered(
            "second",
            lambda options, context: second,
            resources=("a", "b", *(f"r{i}" for i in range(16))),
        ),
    )
    result = registry.probes({"first": {}, "second": {}}, context)
    assert [made.name for made in result.made] == ["first", "second"]
    assert said in failed(result)["second"]
    names = [resource.name for made in result.made for resource in made.resources]
    assert names == ["a", "b", *(f"r{i}" for i in range(14))]
    assert getattr(second, "closed", True)


def labelled(labels):
    probe = Probe("b")
    probe.labels = labels
    return probe


def test_probes_label_their_host(context):
    """The labels of all probes are joined; equal ones do not conflict."""
    registry = registry_of(
        offered("a", lambda options, context: Probe("a")),
        offered("b", lambda options, context: labelled({"gpu.model": "A100", "floor": "2"})),
        offered(
            "c", lambda options, context: SimpleNamespace(
                labels={"floor": "2"}, resources=Probe("c").resources, read=None, close=None
            )
        ),
    )  # fmt: skip
    result = registry.probes({"a": {}, "b": {}, "c": {}}, context)
    assert result.labels == {"gpu.model": "A100", "floor": "2"}
    assert failed(result) == {}


@pytest.mark.parametrize(
    ("labels", "said"),
    [
        (["x"], "has the labels ['x']; a mapping is required"),
        ({"x": 1}, "has the label 'x': 1; printable text of at most 200"),
        ({"": "x"}, "has the label '': 'x'; printable text of at most 200"),
        ({"x": "a\nb"}, "printable text of at most 200"),
        ({"x": "y" * 201}, "printable text of at most 200"),
        ({str(n): "" for n in range(128)}, "exceeds the 128 labels"),
        ({"floor": "3"}, "gives the label 'floor' another value than 'first'"),
    ],
)
def test_a_probe_with_labels_that_cannot_be_taken_fails(context, labels, said):
    """The host keeps the labels of its other probes."""
    first, second = labelled({"floor": "2"}), labelled(labels)
    first.resources = Probe("a").resources
    registry = registry_of(
        offered("first", lambda options, context: first, resources=("a",)),
        offered("second", lambda options, context: second, resources=("b",)),
    )
    result = registry.probes({"first": {}, "second": {}}, context)
    assert said in failed(result)["second"]
    assert result.labels == {"floor": "2"}
    assert second.closed


def run(arguments):
    return {}


def moving(name, executors):
    """Return a plugin with one migration strategy."""
    return plugin(MigrationOffer(name, lambda options: None, executors=executors))


def test_executors_come_from_every_migration_offer():
    """Two offers may share one function."""
    registry = Registry.of(ours=moving("a", {"x": run, "y": run}), theirs=moving("b", {"x": run}))
    strategies = {name: one.strategy for name, one in registry.executors().items()}
    assert strategies == {"x": "b", "y": "a"}
    assert registry.broken == ()


@dataclass(frozen=True)
class OfHost:
    """Options of one host."""

    speed: float = 1.0


def test_an_executor_has_the_options_that_the_host_s_file_gives():
    """Without any the executor uses its own defaults."""
    offer = MigrationOffer("a", lambda options: None, executors={"x": run}, host_options=OfHost)
    registry = Registry.of(ours=plugin(offer), theirs=moving("b", {"y": run}))
    assert registry.executors()["x"].options == {}
    given = registry.executors({"a": {}})
    assert (given["x"].options, given["y"].options) == ({"speed": 1.0}, {})
    with pytest.raises(ConfigError, match="options of 'a': unknown pace"):
        registry.executors({"a": {"pace": 2}})
    with pytest.raises(ConfigError, match="unknown migration strategy 'c'"):
        registry.executors({"c": {}})


def test_offers_with_executors_of_one_name_are_both_broken_and_name_each_other():
    """An order has only the executor's name, so the choice would be random."""
    registry = Registry.of(
        acme=moving("acme", {"rest": run, "other": run}),
        announce=moving("announce", {"rest": lambda arguments: {}}),
        good=moving("good", {"stretch": run}),
    )
    assert sorted(registry.executors()) == ["stretch"]
    said = "its executor 'rest' has the name of one of {} of plugin {}: uninstall one, or rename"
    reasons = registry.broken_strategies()
    assert sorted(reasons) == ["acme", "announce"]
    assert said.format("'announce'", "'announce'") in reasons["acme"]
    assert said.format("'acme'", "'acme'") in reasons["announce"]
    with pytest.raises(ConfigError, match=r"unknown migration strategy 'acme'.*executor 'rest'"):
        registry.migrations({"acme": {}})
    states = {row.name: row.state for row in registry.rows("migration")}
    assert states == {"acme": "broken", "announce": "broken", "good": "available"}


@pytest.mark.parametrize(
    ("executors", "said"),
    [
        (None, "'m': `executors` is None; a mapping is required"),
        ({"rest": 3}, "'m': executor 'rest' is 3; a name and a function are required"),
    ],
)
def test_executors_that_cannot_be_called_break_their_offer(executors, said):
    """The error comes when plugins are loaded, not at the first move."""
    (broken,) = Registry.of(ours=moving("m", executors)).broken
    assert said in broken.reason


def test_a_host_check_that_is_no_executor_of_the_offer_is_refused():
    """Otherwise every host would count as one without the plugin."""
    able = SimpleNamespace(propose=None, host_check="m.abel", host_fault=max)
    offer = MigrationOffer("m", lambda options: able, executors={"m.able": dict})
    registry = registry_of(offer)
    said = r"`host_check` is 'm\.abel', which its offer lacks; there are: m\.able"
    with pytest.raises(PluginError, match=said):
        registry.migrations({"m": {}})


def test_a_host_check_that_cannot_be_read_is_the_plugins_fault():
    """Report a property that raises and a value that is no text as a broken plugin."""

    class Angry:
        propose = host_fault = max

        @property
        def host_check(self):
            raise OSError("no")

    listed = SimpleNamespace(propose=None, host_check=["m.able"], host_fault=max)
    for strategy, said in (
        (Angry(), "its `host_check` raised OSError: no"),
        (listed, r"its `host_check` is \['m.able'\], which its offer lacks"),
    ):
        offer = MigrationOffer("m", lambda options, made=strategy: made)
        registry = registry_of(offer)
        with pytest.raises(PluginError, match=said):
            registry.migrations({"m": {}})


def test_a_create_that_hangs_is_ended_and_named(monkeypatch, context):
    """A probe fails; for a part that the master needs, the error is raised. Nothing hangs."""
    monkeypatch.setattr("rosrm.extensions.guard.LOADING_LIMIT", 0.05)

    def hangs(*_):
        threading.Event().wait()

    registry = registry_of(ProbeOffer("slow", hangs), ScoringOffer("s", hangs))
    said = r"`create` \(.*\) raised TimeoutError: it did not return within 0.05 s; "
    said += r"correct what blocks it, or leave '{}' out of the configuration"
    with pytest.raises(PluginError, match=said.format("s")):
        registry.scoring("s")
    reason = failed(registry.probes({"slow": {}}, context))["slow"]
    assert re.search(said.format("slow"), reason)


def test_a_hook_that_hangs_is_named_while_it_does_and_ended(monkeypatch, caplog):
    """The message has the hook, its place and the line of the hang; the other plugins load."""
    monkeypatch.setattr("rosrm.extensions.guard.LOADING_LIMIT", 0.3)
    monkeypatch.setattr("rosrm.extensions.discovery.SLOW_LOADING", 0.1)

    @hookimpl
    def register_probes():
        threading.Event().wait()

    slow = SimpleNamespace(register_probes=register_probes)
    registry = Registry.of(slow=slow, good=plugin(offered("fine")))
    assert registry.names("probe") == ("fine",)
    (broken,) = registry.broken
    place = f"{__file__}:{register_probes.__code__.co_firstlineno}"
    said = "failed with TimeoutError: it did not return within 0.3 s; move slow work into "
    assert broken.reason.startswith(f"register_probes ({place}) {said}")
    assert broken.reason.endswith(f"({__file__}:{register_probes.__code__.co_firstlineno + 2})")
    said = "plugin 'slow' is still being loaded after 0.1 s: register_probes ("
    assert f"{said}{place}) has not returned; it is ended after 0.3 s" in caplog.text


def test_options_that_cannot_be_read_are_the_plugins_fault():
    @dataclass(frozen=True)
    class Unreadable:
        value: NoSuchType = 1  # noqa: F821 - this is what is wrong with it

    offer = ScoringOffer("s", lambda options: None, Unreadable)
    registry = registry_of(offer)
    with pytest.raises(PluginError, match="its options cannot be read: NameError: name 'NoSuchT"):
        registry.scoring("s")


def test_a_plugin_that_raises_when_it_is_looked_at_is_broken():
    class Angry:
        @property
        def register_probes(self):
            raise OSError("no")

    registry = Registry.of(angry=Angry(), good=plugin(offered("fine")))
    assert registry.names("probe") == ("fine",)
    assert registry.broken[0].reason.startswith("does not import: OSError: no (")
