"""`work.yaml`: processes in the terms of ROS 2 launch, and every error with its place."""

from __future__ import annotations

from dataclasses import dataclass, fields

import pytest

from rosrm.config.process import ProcessInFile
from rosrm.config.work import load_work
from rosrm.errors import ConfigError
from rosrm.extensions.contracts import Capabilities, MigrationOffer
from rosrm.extensions.units import PositiveSeconds
from rosrm.model.values import (
    Component,
    Container,
    Kind,
    LifecyclePolicy,
    Limits,
    MigrationPolicy,
    NeighbourRule,
    ParameterSource,
    ProcessSpec,
    Readiness,
    Realtime,
    RestartPolicy,
    StartOrder,
    StopPolicy,
)
from tests.plugin_kit import registry_of

RELAUNCH = MigrationOffer("relaunch", lambda options: options)


def one(path):
    (spec,) = load_work(path)
    return spec


def test_every_key_of_a_process_reaches_its_spec():
    """A key that is only in the form of the file would be accepted without an effect."""
    in_file = {field.name for field in fields(ProcessInFile)}
    others = {"labels", "near", "apart", "spread", "after"}
    others |= {"parallel", "retries", "every", "at", "on"}
    assert in_file - {field.name for field in fields(ProcessSpec)} == others


def test_every_key_is_read(file):
    spec = one(
        file(
            """
            processes:
              - name: camera
                namespace: /robot1
                package: image_tools
                executable: cam2image
                arguments: [--rate, 5, --verbose]
                parameters: {width: 320, frame: {id: cam, ids: [1, 2]}}
                remappings: {image: /front/image}
                environment: {RATE: 5, DEBUG: true}
                working_directory: /data
                kind: job
                restart: {when: on-failure, delay: 2s, max_delay: 1min, attempts: 3}
                needs: {memory: 500MB, cpu: 0.5, network: 1 MB/s}
                labels: {required: {camera: front}, preferred: {gpu: true}, avoided: {slow: 1}}
                priority: 5
                migration: {strategy: relaunch, overlap: false, options: {a: 1}}
                readiness: {kind: graph, timeout: 10s}
                stop: {interrupt_grace: 1s, terminate_grace: 500ms}
                limits: {memory: 600MB, memory_high: 550 MB, cpu: 1.5 cores, enforce: required}
                cpus: [2, 3]
                nice: -5
            """
        )
    )
    assert (spec.name, spec.namespace) == ("camera", "/robot1")
    assert (spec.program, spec.arguments) == ("image_tools/cam2image", ("--rate", "5", "--verbose"))
    assert spec.parameters == {"width": 320, "frame.id": "cam", "frame.ids": [1, 2]}
    assert spec.remappings == {"image": "/front/image"}
    assert spec.environment == {"RATE": "5", "DEBUG": "true"}
    assert (spec.working_directory, spec.ros, spec.kind) == ("/data", True, Kind.JOB)
    assert spec.restart == RestartPolicy("on-failure", delay=2.0, max_delay=60.0, attempts=3)
    assert spec.needs == {"memory": 5e8, "cpu": 0.5, "network": 1e6}
    assert spec.required_labels == {"camera": "front"}
    assert (spec.preferred_labels, spec.avoided_labels) == ({"gpu": "true"}, {"slow": "1"})
    assert spec.priority == 5
    assert spec.migration == MigrationPolicy("relaunch", False, {"a": 1})
    assert spec.readiness == Readiness("graph", 10.0)
    assert spec.stop == StopPolicy(1.0, 0.5)
    assert spec.limits == Limits(6e8, 5.5e8, 1.5, "required")
    assert (spec.cpus, spec.nice) == ((2, 3), -5)


@pytest.mark.parametrize(
    ("entry", "field", "value"),
    [
        ("command: sleep '1 0'", "command", ("sleep", "1 0")),
        ("command: [sleep, 10]", "command", ("sleep", "10")),
        ("command: x", "restart", RestartPolicy("on-failure")),
        ("command: x, restart: {delay: 3s}", "restart", RestartPolicy("on-failure", delay=3.0)),
        ("command: x, kind: job", "restart", RestartPolicy("never")),
        ("command: x, kind: job, restart: always", "restart", RestartPolicy("always")),
        ("command: x, restart: never", "restart", RestartPolicy("never")),
        ("command: x, migration: relaunch", "migration", MigrationPolicy("relaunch")),
        ("command: x, migration: null", "migration", MigrationPolicy()),
        ("command: x, readiness: running", "readiness", Readiness("running")),
        ("package: p, executable: e, lifecycle: active", "lifecycle", LifecyclePolicy("active")),
        (
            "module: e, ros: true, components: [{plugin: q, name: c, parameters: {a: {b: 1}}}]",
            "components",
            (Component("q", "c", parameters={"a.b": 1}),),
        ),
        (
            "package: p, executable: e, lifecycle: {timeout: 5s}",
            "lifecycle",
            LifecyclePolicy("active", 5.0),
        ),
        ("package: p, executable: e", "lifecycle", LifecyclePolicy("unmanaged")),
        ("package: p, executable: e", "ros", True),
        ("package: p, executable: e, ros: false", "ros", False),
        ("command: x, near: b", "neighbours", (NeighbourRule("near", ("b",)),)),
        ("command: x, near: []", "neighbours", ()),
        ("command: x, talks_to: {b: 30MB/s, c: 5}", "talks_to", {"b": 30e6, "c": 5.0}),
        ("command: x, talks_to: {memory: 1KiB/s}", "talks_to", {"memory": 1024.0}),
        ("command: x, secrets: {T: {file: /etc/t}}", "secrets", {"T": "/etc/t"}),
        ("command: x, secrets:", "secrets", {}),
        ("command: x, container: ros:jazzy", "container", Container("ros:jazzy", "podman")),
        ("command: x, container: {image: a, engine: b}", "container", Container("a", "b")),
        (
            "command: x, apart: [b, {processes: [d], by: rack, prefer: true}, 5]",
            "neighbours",
            (
                NeighbourRule("apart", ("b", "5")),
                NeighbourRule("apart", ("d",), by="rack", prefer=True),
            ),
        ),
        (
            "command: x, spread: rack",
            "neighbours",
            (NeighbourRule("apart", group="a", by="rack"),),
        ),
        (
            "command: x, spread: {group: g, prefer: true}",
            "neighbours",
            (NeighbourRule("apart", group="g", prefer=True),),
        ),
        (
            "command: x, realtime: {policy: fifo, priority: 40}",
            "realtime",
            Realtime("fifo", 40),
        ),
        ("command: x, after: b", "start_order", StartOrder({"b": "ready"})),
        ("command: x, after: [b, c]", "start_order", StartOrder({"b": "ready", "c": "ready"})),
        (
            "command: x, after: {b: finished, delay: 500ms, on_restart: restart}",
            "start_order",
            StartOrder({"b": "finished"}, 0.5, "restart"),
        ),
        ("command: x, after: []", "start_order", StartOrder()),
        ("module: m", "ros", False),
        ("module: m, ros: true, remappings: [[a, b]]", "remappings", {"a": "b"}),
        ("module: m, ros: true, parameters: {a: {b: 1}}", "parameters", {"a.b": 1}),
        (
            "module: m, ros: true, parameters: [/p, {a: {b: 1}}, {/n: {ros__parameters: {c: 1}}}]",
            "parameter_sources",
            (
                ParameterSource("/p"),
                ParameterSource(parameters={"a.b": 1}),
                ParameterSource(nodes="/n", parameters={"c": 1}),
            ),
        ),
        ("command: x, prefix: nice -n 5", "prefix", ("nice", "-n", "5")),
    ],
)
def test_shorthands_stand_for_the_long_forms(file, entry, field, value):
    assert getattr(one(file(f"processes: [{{name: a, {entry}}}]")), field) == value


def test_the_processes_of_one_entry_are_one_group(file):
    """The group has the name of the entry; a name that the file gives stays."""
    specs = load_work(
        file(
            """
            defaults: {command: x, spread: rack}
            processes:
              - {name: "a_{i:02d}", foreach: {i: "range(0, 2)"}, near: "cam_{i}"}
              - {name: "b_{i}", foreach: {i: [1]}, spread: {group: "g_{i}", by: ""}}
            """
        )
    )
    groups = [rule.group for spec in specs for rule in spec.neighbours if rule.group]
    assert groups == ["a_{i:02d}", "a_{i:02d}", "g_1"]
    assert [spec.neighbours[0].processes for spec in specs] == [("cam_0",), ("cam_1",), ()]


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ("near: [a]", "near: a names itself; only other processes are allowed"),
        ("apart: {processes: [a]}", "apart: a names itself"),
        ("apart: {processes: []}", "apart: at least one process is required"),
        ("near: {by: rack}", "near[0].processes: is missing"),
        ("near: [../b]", "near: "),
        ("talks_to: {a: 1MB/s}", "talks_to: a names itself; only other processes are allowed"),
        ("talks_to: {../b: 1MB/s}", "talks_to: '../b' cannot be the name of a process"),
        ("talks_to: {b: fast}", "talks_to.b: 'fast' is not a number, or text such as \"30MB/s\""),
        ("talks_to: {b: .nan}", "talks_to.b: "),
        ("talks_to: {b: .inf}", "talks_to.b: "),
        ("talks_to: {b: -1MB/s}", "talks_to.b: '-1MB/s' is not within 0..1e+15"),
        ("talks_to: {b: 30MB}", "talks_to.b: unknown unit 'MB'; did you mean 'MB/s'?"),
        ("talks_to: [b]", "talks_to: a mapping is required, not a list, such as `talks_to: {"),
        ("after: a", "after: a names itself; only other processes are allowed"),
        ("after: [../b]", "after: '../b' cannot be the name of a process"),
        (
            "after: {b: started}",
            'after.b: "started" is unknown. Allowed: ready, finished',
        ),
        (
            "after: {b: ready, delay: soon}",
            "after.delay: 'soon' is not a number, or text such as \"500ms\"",
        ),
        (
            "after: {b: ready, on_restart: restarts}",
            "after.on_restart: \"restarts\" is unknown; did you mean 'restart'?",
        ),
        ("after: {delay: 2s}", "after: the name of at least one process is required"),
        ("after: 5", "after: a mapping is required, not 5, such as `after: camera` or `after: {"),
        ("secrets: {T: {file: t}}", "secrets.T: 't' is no absolute path. A host reads the file"),
        ("secrets: {T: {file: ~/t}}", "secrets.T: '~/t' is no absolute path"),
        ("secrets: {T: {file: /t}}, environment: {T: x}", "secrets.T: `environment` sets T, too"),
        ("secrets: {A=B: {file: /t}}", "secrets: 'A=B' cannot be a variable"),
        ("secrets: {PATH: {file: /t}}", "secrets.PATH: rosrm itself sets or reads PATH"),
        ("secrets: {ROSRM_HOST: {file: /t}}", "secrets.ROSRM_HOST: rosrm itself sets or reads"),
        ("container: {engine: podman}", "container.image: is missing"),
        ("container: --privileged", "container.image '--privileged': a name is required"),
        ("secrets: {T: {fiel: /t}}", "unknown key 'fiel' in secrets.T; did you mean 'file'?"),
        ("secrets: {T: /t}", 'secrets.T: a mapping is required, not "/t"'),
        ("near: [[b]]", "near[0].processes[0]: text is required, not a list"),
        ("spread: true", "spread.by: text is required, not true, such as `spread: rack` or"),
        ("spread: {}", "spread: {} spreads the processes of one entry with `foreach`"),
        ("near: true", "near[0].processes[0]: text is required, not true, such as `near: camera`"),
        ("together: true", "together: text is required, not true, such as `together: swarm`"),
        ("health: {}", "health: {} has no condition, such as `health: {topic: scan, rate: 10}`"),
        ("reschedule: {}", "reschedule: {} allows no other host, such as `reschedule: {attempts"),
        ("spread: {groups: g}", "unknown key 'groups' in spread; did you mean 'group'?"),
        ("near: {processes: [b], prefer: 1}", "near[0].prefer: true or false is required, not 1"),
    ],
)
def test_faults_of_neighbours_flows_and_secrets_are_named(file, entry, text):
    path = file(
        f"""
        processes:
          - {{name: a, command: x, {entry}}}
        """
    )
    with pytest.raises(ConfigError) as error:
        load_work(path)
    assert text in str(error.value)


#: Keys that the examples of others need.
BESIDE = {
    "spread": "foreach: {i: [1, 2]}", "at": "kind: job", "on": "kind: job, at: '06:00'",
    "standby": "migration: handoff", "health": "ros: true", "parameters": "ros: true",
    "remappings": "ros: true", "lifecycle": "ros: true",
    "components": "ros: true",
}  # fmt: skip


@pytest.mark.parametrize("key", ProcessInFile.EXAMPLES)
def test_the_examples_in_messages_are_valid(file, key):
    """A user copies them."""
    for form in ProcessInFile.EXAMPLES[key]:
        name = "a{i}" if key == "spread" else "a"
        entry = f"name: {name!r}, command: x, {key}: {form}, {BESIDE.get(key, '')}"
        assert load_work(file(f"processes: [{{{entry}}}]"), check_artifacts=False)


def test_the_sections_of_the_file_are_no_keys_of_a_process(refusal):
    """The message says where they belong, and lists no keys."""
    said = refusal(load_work, "processes: [{name: a, command: x, group: {name: g}}]")
    assert said.endswith(
        "unknown key 'group'; `group` is a section of the file, beside `processes`"
    )


def test_an_empty_spread_of_an_entry_for_many_means_different_hosts(file):
    """The entry is the group, and no label is named."""
    text = 'processes: [{name: "a{i}", foreach: {i: [1, 2]}, command: x, spread: {}}]'
    rules = [spec.neighbours for spec in load_work(file(text))]
    assert rules == [(NeighbourRule("apart", group="a{i}"),)] * 2


@pytest.mark.parametrize(
    ("a", "b", "text"),
    [
        ("", "after: {a: finished}", ":4:38: after: a is a service, which does not finish; use"),
        (
            "kind: job, every: 1h", "after: {a: finished}",
            ":4:38: after: a has a schedule, so it never finishes; use",
        ),
        ("near: b, apart: b", "", ":3:5: a and b must run apart, and near each other: no hosts"),
        (
            "near: b, labels: {required: {arm: left}}", "labels: {required: {arm: right}}",
            "a and b must run near each other, but a requires arm=left, and b arm=right",
        ),
    ],
)  # fmt: skip
def test_contradictions_within_a_file_are_refused_at_their_place(refusal, a, b, text):
    """The master would refuse the submission, and could not name the line."""
    entries = f"processes:\n  - {{name: a, command: x, {a}}}\n  - {{name: b, command: x, {b}}}"
    assert text in refusal(load_work, f"\n{entries}")


def test_a_circle_of_starts_is_refused_at_its_place(file):
    """The chain names all processes of the circle."""
    path = file(
        """
        defaults: {command: x}
        processes:
          - {name: a, after: {other: ready, b: finished}}
          - {name: b, after: [c], kind: job}
          - {name: c, after: a}
        """
    )
    with pytest.raises(ConfigError) as error:
        load_work(path)
    (line,) = str(error.value).splitlines()
    assert "a -> b -> c -> a is a circle, in which each process starts after the next" in line


def test_a_gang_that_can_never_start_is_refused_at_its_place(refusal):
    """All processes of a gang are placed in one step."""
    said = refusal(
        load_work,
        """
        defaults: {command: x}
        processes:
          - {name: a, together: g}
          - {name: b, together: g, after: c}
          - {name: c, after: a}
        """,
    )
    assert (
        "f.yaml:5:35: after: b starts after c and c starts after a, but the gang g starts" in said
    )
    said = refusal(
        load_work,
        """
        processes:
          - {name: j, kind: job, command: x, array: 0-2, parallel: 2, together: g}
        """,
    )
    assert "f.yaml:3:73: together: 3 jobs of the array j are in the gang g and start at" in said


def test_a_start_order_of_an_entry_for_many_processes(file):
    """The values of `foreach` are filled into names; defaults lie under them."""
    specs = load_work(
        file(
            """
            defaults: {command: x, after: {delay: 2s}}
            processes:
              - {name: "view_{i}", foreach: {i: [1, 2]}, after: "cam_{i}", kind: job}
              - {name: map, after: {"view_{x}": finished}, foreach: [{x: 1}]}
            """
        )
    )
    assert [spec.start_order for spec in specs] == [
        StartOrder({"cam_1": "ready"}, 2.0), StartOrder({"cam_2": "ready"}, 2.0),
        StartOrder({"view_1": "finished"}, 2.0),
    ]  # fmt: skip


def test_defaults_lie_under_each_process_in_depth(file):
    first, second = load_work(
        file(
            """
            defaults:
              module: m
              needs: {memory: 10MB, cpu: 1}
              restart: on-failure
              migration: {strategy: relaunch, overlap: false, options: {a: 1}}
            processes:
              - {name: a, needs: {memory: 20MB}, restart: {delay: 5s}}
              - {name: b, command: x, migration: other}
            """
        )
    )
    assert (first.module, first.needs) == ("m", {"memory": 20e6, "cpu": 1.0})
    assert first.restart == RestartPolicy("on-failure", delay=5.0)
    assert first.migration == MigrationPolicy("relaunch", False, {"a": 1})
    assert (second.module, second.command) == (None, ("x",))
    assert second.migration == MigrationPolicy("other", False, {})


def test_a_spec_names_the_given_keys_and_those_of_the_defaults(file):
    """So the master can tell them from keys that were left out, which the cluster may fill."""
    spec = one(
        file("""\
            defaults: {restart: on-failure}
            processes:
              - {name: p, module: m, migration: , health: , stop: {interrupt_grace: 5s}}
            """)
    )
    assert sorted(spec.given) == [
        "health", "migration.strategy", "module", "name", "restart.when", "stop.interrupt_grace",
    ]  # fmt: skip


def test_all_entries_of_a_file_together_make_a_bounded_number(tmp_path):
    """Each entry alone is within the bound."""
    entries = "".join(
        f"  - {{name: 'p{n}_{{i}}', foreach: {{i: 'range(0, 4000)'}}, command: x}}\n"
        for n in range(3)
    )
    file = tmp_path / "work.yaml"
    file.write_text(f"processes:\n{entries}")
    with pytest.raises(ConfigError, match="the file makes more than 10000 processes"):
        load_work(file)


def test_foreach_makes_many_alike(file):
    specs = load_work(
        file(
            """
            processes:
              - name: "hold_{mb:02d}_{who}"
                foreach: {mb: "range(8, 25, 8)", who: [ann, bob]}
                command: "hold {mb} {{mb}}"
                needs: {memory: "{mb}MB"}
                priority: "{mb}"
            """
        )
    )
    assert [spec.name for spec in specs[:3]] == ["hold_08_ann", "hold_08_bob", "hold_16_ann"]
    assert len(specs) == 6
    assert specs[-1].command == ("hold", "24", "{mb}")
    assert (specs[-1].needs, specs[-1].priority) == ({"memory": 24e6}, 24)


def test_foreach_rows_may_be_listed(file):
    rows = "[{i: 1, mb: 8}, {i: 7, mb: 80}]"
    text = f"processes: [{{name: 'p{{i}}', foreach: {rows}, command: 'hold {{mb}}'}}]"
    specs = load_work(file(text))
    assert [(spec.name, spec.command[1]) for spec in specs] == [("p1", "8"), ("p7", "80")]


def test_braces_are_plain_without_foreach(file):
    assert one(file("processes: [{name: a, command: ['echo', '${HOME}']}]")).command[1] == "${HOME}"


@pytest.mark.parametrize(
    ("foreach", "name", "said"),
    [
        ("{i: range(3)}", "n{j}", "f.yaml:1:20: 'n{j}': unknown name 'j'. Allowed: i"),
        ("{i: range(3)}", "n", "f.yaml:1:20: foreach gives every process the name 'n'"),
        ("{i: range(3)}", "n{i", "a single brace; write {{ for a plain one"),
        ("{i: range(3)}", "n{i:zz}", "'n{i:zz}': 'zz' is no format for 0"),
        ("{i: range(3)}", "n{i:099999}", "'099999' is no format for 0"),
        ("{i: range(3)}", "n{i.x}", "unknown name 'i.x'"),
        (f"{{i: range({'9' * 5000})}}", "n{i}", "a list or range(first, end) is required, not"),
        ("{i: [1]}", "n{i:c}{i:1000c}", "is no format for 1"),
        (f"{{i: [{10**12}]}}", "n{i:c}", f"'c' is no format for {10**12}"),
        ("{i: range(0)}", "n{i}", "f.yaml:1:37: foreach: makes no process"),
        ("{i: 'range(0,5,0)'}", "n{i}", "f.yaml:1:41: foreach.i: a step of 0"),
        ("{i: range(10001)}", "n{i}", "foreach: makes more than 10000 processes"),
        (f"{{i: range({'9' * 5000})}}", "n{i}", "foreach.i: a list or range(first, end) is requi"),
        ("{i: [-1]}", "n{i:c}", "'n{i:c}': 'c' is no format for -1"),
        (
            "{i: 5}",
            "n{i}",
            "f.yaml:1:41: foreach.i: a list or range(first, end) is required, not 5",
        ),
        ("{i: [[1]]}", "n{i}", "f.yaml:1:42: foreach: text or a number is required, not a list"),
        (
            "[{i: 1}, {j: 1}]",
            "n{i}",
            "f.yaml:1:46: foreach: this entry has the names j, and the first entry i",
        ),
        ("3", "n", "f.yaml:1:34: foreach: a mapping from a name to its values is required"),
        ("[1]", "n", "f.yaml:1:35: foreach: each entry of a list must map names to values"),
    ],
)
def test_a_wrong_foreach_is_refused_with_its_place(refusal, foreach, name, said):
    text = f"processes: [{{name: '{name}', foreach: {foreach}, command: x}}]"
    assert said in refusal(load_work, text)


def test_duplicate_names_are_refused_naming_both_places(refusal):
    said = refusal(
        load_work,
        """
        processes:
          - {name: a1, command: x}
          - {name: "a{i}", foreach: {i: [0, 1]}, command: x}
        """,
    )
    assert said == "f.yaml:4:12: duplicate process name 'a1', first given at line 3, column 12"


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (
            "name: a",
            "f.yaml:1:13: no program is given; give one of package + executable, module or command",
        ),
        ("name: a, command: x, module: y", "module and command are given; give one of"),
        ("name: a, package: p", "f.yaml:1:32: package 'p' is given without an executable"),
        ("name: a, executable: e", "executable 'e' is given without a package; a program that"),
        ("command: x", "f.yaml:1:13: name: is missing"),
        ("name: a b, command: x", "f.yaml:1:20: 'a b' cannot be the name of a process"),
        ("name: a-b, package: p, executable: e", "'a-b' cannot be the name of a ROS node"),
        ("name: a, command: x, parameters: {b: 1}", "parameters: only a ROS node has one"),
        ("name: a, command: x, namespace: /b", "namespace: only a ROS node has one"),
        ("name: a, command: x, readiness: graph", "only a ROS node is seen in the graph"),
        ("name: a, module: x, ros: true, namespace: b", "'b' is not an absolute namespace"),
        ("name: a, module: x, ros: true, parameters: {b: }", "parameters.b: a value is required"),
        ("name: a, module: x, ros: true, parameters: 5", "parameters: a mapping is required"),
        ("name: a, module: x, ros: true, parameters: [5]", "parameters: entry 1: the path of a"),
        ("name: a, module: x, ros: true, parameters: [{a: }]", "parameters: /** a: a value is"),
        ("name: a, command: x, parameters: [{a: 1}]", "parameters: only a ROS node has one"),
        ("name: a, command: x, node_name: b", "node_name: only a ROS node has one"),
        ("name: a, module: x, ros: true, node_name: b.c", "'b.c' cannot be the name of a ROS node"),
        ("name: b.c, module: x, ros: true", "another name than the process, set `node_name`"),
        (
            "name: a, module: x, ros: true, node_name: keep, health: {lifecycle: active}",
            "`node_name: keep` leaves it unknown",
        ),
        (
            "name: a, module: x, ros: true, node_name: keep, lifecycle: active",
            "lifecycle: the name of the node is required",
        ),
        ("name: a, command: x, lifecycle: active", "lifecycle: only a ROS node has a lifecycle"),
        (
            "name: a, module: x, ros: true, readiness: running, lifecycle: inactive",
            "`readiness: running` does not wait for that",
        ),
        ("name: a, module: x, ros: true, lifecycle: on", "autostart"),
        ("name: a, command: x, components: [{plugin: p, name: c}]", "set `ros: true`"),
        ("name: a, module: rosrm.component, arguments: [b, 'm:C']", "needs `ros: true` and"),
        ("name: a, module: rosrm.component, ros: true, arguments: [b]", "[CONTAINER, PLUGIN]"),
        (
            "name: a, module: x, ros: true, components: [&c {plugin: p, name: c}, *c]",
            "/c is there twice",
        ),
        ("name: a, module: x, ros: true, components: [{plugin: '', name: c}]", "has no plugin"),
        ("name: a, module: x, ros: true, components: [{plugin: p, name: c d}]", "'c d' cannot be"),
        (
            "name: a, module: x, ros: true, components: [{plugin: p, name: c, namespace: d}]",
            "is not an absolute namespace",
        ),
        (
            "name: a, module: x, ros: true, lifecycle: active, components: [{plugin: p, name: c}]",
            "a container has no lifecycle",
        ),
        ("name: a, command: 'x $(find-pkg-share b)'", "write a list of words"),
        ("name: a, module: x, ros: true, parameters: {b: [1, a]}", "values of one type"),
        ("name: a, module: x, ros: true, parameters: {b: .nan}", "a finite number is required"),
        ("name: a, module: x, ros: true, parameters: {b: [9223372036854775808]}", "of 64 bits is"),
        ("name: a, command: x, working_directory: ''", "f.yaml:1:54: working_directory: "),
        ("name: a, command: x, environment: {A=B: c}", "'A=B' cannot be a variable"),
        (
            f"name: a, command: x, environment: {{A: {'x' * (1 << 17)}}}",
            "environment.A: too long: at most 128 KiB",
        ),
        ("name: a, command: x, restart: sometimes", 'restart.when: "sometimes" is unknown'),
        ("name: a, command: x, restart: {when: always, delay: 1h}", "max_delay must not be less"),
        ("name: a, command: x, kind: jobs", """kind: "jobs" is unknown; did you mean 'job'?"""),
        ("name: a, command: x, priority: high", "priority: 'high' is not a whole number"),
        ("name: a, command: x, needs: {memory: lots}", "needs.memory: 'lots' is not a number"),
        ('name: a, command: "echo \'x"', "cannot be split into words: it has no closing '"),
        ("name: a, comand: x", "unknown key 'comand'; did you mean 'command'?"),
        ("name: a, command: x, hosts: [b]", "unknown key 'hosts'; did you mean 'labels'?"),
        ("name: a, command: x, cwd: /b", "unknown key 'cwd'; did you mean 'working_directory'?"),
        ("name: a, command: x, memory: 1GB", "unknown key 'memory'; did you mean 'needs'?"),
        ("name: a, command: x, labels: {need: {}}", "unknown key 'need' in labels"),
        ("name: a, module: x, ros: true, remappings: [[a]]", "remappings: a mapping is required"),
    ],
)
def test_a_wrong_entry_is_refused_with_its_place(refusal, entry, said):
    assert said in refusal(load_work, f"processes: [{{{entry}}}]")


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("command: x, module: y, prioritty: 1", "module and command are given; give one of"),
        ("command: x, health: {topic: /scan}, prioritty: 1", "health.topic and health.rate"),
        ("command: x, isolation: {after: 1s}, priority: high", "isolation.after requires"),
        ("command: x, time_limit: 1s, prioritty: 1", "time_limit: only a job has one"),
        ("command: x, reschedule: {delay: 1s}, prioritty: 1", "reschedule.delay requires"),
        ("command: x, migration: relunch, prioritty: 1", "unknown migration strategy 'relunch'"),
        ("command: x, migration: {strategy: relunch, overlapp: true}, prioritty: 1",
         "unknown migration strategy 'relunch'"),
    ],
)  # fmt: skip
def test_a_conflict_of_keys_is_reported_along_with_a_wrong_key(refusal, entry, said):
    """The message lists all errors at once, not one stage of the check after the other."""
    found = refusal(load_work, f"processes: [{{name: a, {entry}}}]", registry_of(RELAUNCH))
    assert said in found
    assert "priori" in found


@pytest.mark.parametrize(
    "entry",
    [
        "comand: x", "pkg: p, exec: e", "package: [p], executable: e, parameters: {b: 1}",
        "module: 5, ros: 3",
    ],
)  # fmt: skip
def test_an_unreadable_key_is_not_reported_as_missing(refusal, entry):
    """Errors that only follow from the first one are left out."""
    said = refusal(load_work, f"processes: [{{name: a, {entry}}}]")
    assert "exactly one of" not in said
    assert "only a ROS node" not in said


def test_the_allowed_keys_are_listed_once(refusal):
    said = refusal(load_work, "processes: [{name: a, comand: x, nam: b, lables: {}}]")
    assert said.count("unknown key") == 3
    assert said.count("Allowed:") == 1


# --- paths and programs -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entry", "command", "directory"),
    [
        ("command: ./run.sh -v", ("{here}/run.sh", "-v"), None),
        ("command: [bin/run, ./map.yaml]", ("{here}/bin/run", "./map.yaml"), None),
        ("command: [python3, brain.py], working_directory: .", ("python3", "brain.py"), "{here}"),
        ("command: x, working_directory: ../data", ("x",), "{above}/data"),
        ("command: ~/run.sh, working_directory: ~/maps", ("~/run.sh",), "~/maps"),
        ("command: /bin/true, working_directory: /tmp", ("/bin/true",), "/tmp"),
        (
            "command: ['$(find-pkg-prefix a)/x'], working_directory: $(find-pkg-share a)/b",
            ("$(find-pkg-prefix a)/x",),
            "$(find-pkg-share a)/b",
        ),
    ],
)
def test_a_relative_program_or_directory_is_beside_the_file(
    file, monkeypatch, entry, command, directory
):
    """The slave replaces `~` by the home of its user. Arguments are passed as they are."""
    path = file(f"processes: [{{name: a, {entry}}}]")
    monkeypatch.chdir(path.parent)
    (spec,) = load_work(path.name)  # the file's own path may be relative, too

    def there(text):
        return text and text.format(here=path.parent, above=path.parent.parent)

    assert spec.command == tuple(map(there, command))
    assert spec.working_directory == there(directory)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("echo hi && echo done", "&&"),
        ("echo a; echo b", ";"),
        ("ls *.bag", "*"),
        ("echo $HOME", "$HOME"),
        ("echo ${HOME}", "${HOME"),
        ("make > log", ">"),
        ("dmesg | tail", "|"),
        ("echo `date`", "`"),
        ("python3 ~/brain.py", "~"),
        ("sleep 600 &", "&"),
        ("play # loudly", "#"),
        ("echo $$", "$$"),
        ("play {a,b}.bag", "{a,b}"),
        ("play {1..3}", "{1..3}"),
        ("play (a)", "("),
    ],
)
def test_what_a_shell_would_read_is_pointed_out(refusal, text, found):
    """No shell reads a command, so shell syntax would be passed on literally."""
    for key in ("command", "arguments"):
        program = "module: m, " if key == "arguments" else ""
        said = refusal(load_work, f"processes: [{{name: a, {program}{key}: '{text}'}}]")
        assert f"{found!r} outside quotes, and no shell reads it" in said
        assert f'[bash, -c, "{text}"]' in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("|\n      echo a\n      echo b\n", "has several lines, but a command has one"),
        ("|\n      echo a \\\n      b\n", "has several lines"),
        ('|\n      echo "a \\\n      b"\n', "has several lines"),
        ("RATE=3 play", "begins with 'RATE=', which sets a variable only in a shell"),
        ("cd /tmp", "begins with 'cd', which is a shell command, not a program"),
        ("'echo \"$HOME/x\"'", "has '$HOME' in double quotes, where a shell would replace it"),
        ("'echo \"`date`\"'", "has '`' in double quotes"),
    ],
)
def test_what_only_a_shell_would_do_with_a_command_is_refused(refusal, text, said):
    """The program would get other words than the user means; the error names a remedy."""
    message = refusal(load_work, f"processes:\n  - name: a\n    command: {text}")
    assert said in message
    assert "Write [bash, -c, " in message or "Write it on one line" in message


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("|\n      echo a\n", ("echo", "a")),
        (">\n      echo\n      a\n", ("echo", "a")),
        ("|\n      sh -c 'echo a\n      echo b'\n", ("sh", "-c", "echo a\necho b")),
        ("'sh -c \"echo \\$1\"'", ("sh", "-c", "echo $1")),
        ("play x_{name} rate:=3 a=b", ("play", "x_{name}", "rate:=3", "a=b")),
        ("'bash -c \"cd /tmp && echo $HOME\"'", ("bash", "-c", "cd /tmp && echo $HOME")),
        ("[echo, a && b, $HOME, ~/state]", ("echo", "a && b", "$HOME", "~/state")),
        ("\"grep 'a|b*' log\"", ("grep", "a|b*", "log")),
        ("'find . -name \\*.py'", ("find", ".", "-name", "*.py")),
        ("ros2 topic /a~ [1,2] x?y a#b", ("ros2", "topic", "/a~", "[1,2]", "x?y", "a#b")),
    ],
)
def test_quoted_words_and_lists_are_passed_as_they_are(file, given, words):
    assert one(file(f"processes:\n  - name: a\n    command: {given}\n")).command == words


# --- files ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "f.yaml:1:1: processes: a list of at least one process is required"),
        ("processes: []", "f.yaml:1:12: processes: a list of at least one"),
        ("processes: [a]", "f.yaml:1:13: processes: each entry must be a mapping"),
        ("- {name: a}", "f.yaml:1:1: a work file is a mapping, not a list; put the list under `pr"),
        ("exec python3 robot", "f.yaml:1:1: a work file is a mapping, not text; it has `proces"),
        ("defaults: {name: x}\nprocesses: []", "f.yaml:1:12: defaults: name is allowed in"),
        ("defaults: 5\nprocesses: []", "f.yaml:1:11: defaults: a mapping is required"),
    ],
)
def test_a_wrong_file_is_refused_with_its_place(refusal, text, said):
    assert said in refusal(load_work, text)


def test_a_misspelt_section_is_one_error(refusal):
    said = refusal(load_work, "proceses: [{name: a, command: x}]")
    assert said == (
        "f.yaml:1:1: unknown key 'proceses'; did you mean 'processes'? Allowed: app, "
        "rollout, processes, defaults, group"
    )


def test_a_fault_in_defaults_is_reported_once_at_its_place(refusal):
    processes = "processes: [{name: a, command: x}, {name: b, command: x}]"
    said = refusal(load_work, f"defaults: {{needs: {{memory: 64mib}}}}\n{processes}")
    assert said.startswith("f.yaml:1:28: needs.memory: unknown unit 'mib'; did you mean 'MiB'?")


def test_with_a_registry_the_strategy_and_its_options_are_checked(refusal):
    said = refusal(
        load_work,
        """
        processes:
          - {name: a, command: x, migration: relunch}
          - {name: b, command: x, migration: {strategy: relaunch, options: {fast: 1}}}
        """,
        registry_of(RELAUNCH),
    )
    assert "f.yaml:3:38: unknown migration strategy 'relunch'; did you mean 'relaunch'?" in said
    assert "f.yaml:4:69: unknown key 'fast' in options of migration strategy 'relaunch'" in said


def test_a_standby_needs_a_strategy_that_can_shadow(file, refusal):
    """Whatever its name is; without a registry the master refuses it."""
    text = "processes: [{name: a, command: x, standby: true, migration: STRATEGY}]"
    follows = Capabilities(shadow=True)
    follow = MigrationOffer("follow", lambda options: options, capabilities=follows)
    registry = registry_of(RELAUNCH, follow)
    said = refusal(load_work, text.replace("STRATEGY", "relaunch"), registry)
    assert "f.yaml:1:44: a standby needs a migration strategy that copies state" in said
    assert "relaunch has no standby: write `migration: follow`" in said
    assert "no migration strategy is given" in refusal(load_work, text.replace("STRATEGY", "null"))
    for known in (registry, None):
        (spec,) = load_work(file(text.replace("STRATEGY", "follow")), known)
        assert spec.standby.wanted


def test_a_container_needs_a_strategy_that_starts_the_process_again(file, refusal):
    """Neither its memory nor its snapshots can be moved; without a registry the master refuses."""
    text = "processes: [{name: a, command: x, container: img, migration: STRATEGY}]"
    keeps = MigrationOffer("keep", lambda options: options, capabilities=Capabilities("memory"))
    said = refusal(load_work, text.replace("STRATEGY", "keep"), registry_of(RELAUNCH, keeps))
    assert "f.yaml:1:46: keep moves the state of a process, which is not possible with a" in said
    (spec,) = load_work(file(text.replace("STRATEGY", "relaunch")), registry_of(RELAUNCH, keeps))
    assert spec.program == "x in img"


@dataclass(frozen=True)
class Waits:
    """Options with a unit."""

    start: PositiveSeconds = 5.0
    ready: PositiveSeconds = 10.0


def test_only_options_given_by_a_process_override_those_of_the_cluster(file):
    """Values are in base units.

    Missing options keep the cluster's values, not the plugin's defaults.
    """
    registry = registry_of(MigrationOffer("patient", lambda options: options, Waits))
    migration = "{strategy: patient, options: {ready: 1 min}}"
    text = f"processes: [{{name: a, command: x, migration: {migration}}}]"
    (spec,) = load_work(file(text), registry)
    assert spec.migration.options == {"ready": 60.0}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("parameters: {a: []}", "parameters.a: an empty list has no type"),
        ("parameters: {a: \"x\\0y\"}", "parameters.a: a text without the character NUL"),
        ("parameters: [{'/**': {ros__parameters: {a: []}}}]", "an empty list has no type"),
        ("components: [{plugin: p, name: n, parameters: {a: []}}]", "n: a: an empty list has no"),
        ("components: [{plugin: p, name: n, arguments: {a: [1, x]}}]", "n: a: a list in ROS"),
        ("remappings: {a b: c}", "remappings: 'a b' is no name in ROS"),
        ("remappings: {a: ''}", "remappings: '' is no name in ROS"),
    ],
)  # fmt: skip
def test_what_every_host_would_refuse_is_refused_before(refusal, keys, said):
    assert said in refusal(load_work, f"processes: [{{name: a, command: x, ros: true, {keys}}}]")


@pytest.mark.parametrize("text", ["/x:$PYTHONPATH", "/x:${PYTHONPATH}", "$PYTHONPATH"])
def test_a_variable_that_only_a_shell_replaces_is_refused(refusal, text):
    """The program would search a directory named `$NAME`; the error names `{env.NAME}`."""
    entry = f"{{name: a, command: x, environment: {{PYTHONPATH: '{text}'}}}}"
    said = refusal(load_work, f"processes: [{entry}]")
    assert "no shell reads it. Write {env.PYTHONPATH} for the value" in said


def test_a_variable_of_the_host_stands_in_variables_only(file, refusal):
    """The values of `foreach` may stand beside them."""
    text = "processes: [{name: 'a{i}', foreach: {i: [1]}, command: x, KEY}]"
    ok = text.replace("KEY", "environment: {P: '/{i}:{env.P}', Q: 'a$ 5$'}")
    assert one(file(ok)).environment == {"P": "/1:{env.P}", "Q": "a$ 5$"}
    said = refusal(load_work, text.replace("KEY", "arguments: ['{env.P}']"))
    assert "arguments: {env.NAME} is allowed only in `environment`" in said


def test_a_home_in_the_first_argument_is_refused_too(refusal):
    """No argument may have a `~`, because the host replaces it only in the program."""
    said = refusal(load_work, "processes: [{name: a, module: m, arguments: ~/maps}]")
    assert "'~' outside quotes" in said
