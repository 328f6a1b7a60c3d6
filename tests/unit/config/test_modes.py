"""`modes.yaml`: applications by their files, with parameters, limits, weights and conditions."""

from __future__ import annotations

import pytest

from rosrm.config.modes import load_modes
from rosrm.model.modes import Trigger
from rosrm.slave.launch.parameter_files import all_parameters

NAVIGATION = """\
app: navigation
processes:
  - {name: planner, package: nav, executable: planner, parameters: {speed: 1.0, frame: {id: map}}}
  - {name: logger, command: [log]}
"""


@pytest.fixture(autouse=True)
def _work_files(tmp_path):
    (tmp_path / "navigation.yaml").write_text(NAVIGATION, encoding="utf-8")
    mapping = "app: mapping\nprocesses: [{name: mapper, command: [map]}]\n"
    (tmp_path / "mapping.yaml").write_text(mapping, encoding="utf-8")
    other = "app: other\nprocesses: [{name: logger, command: [log]}]\n"
    (tmp_path / "other.yaml").write_text(other, encoding="utf-8")


def test_every_key_of_a_mode_is_read(file) -> None:
    """Work files are found beside the file, and parameters go into their processes."""
    exploring, docked = load_modes(
        file(
            """
            modes:
              exploring:
                applications: [navigation.yaml, mapping.yaml]
                parameters: {planner: {speed: 0.5, frame: {id: odom}}}
                limits: {memory: 0.7}
                weights: {memory: 1, cpu: 0.2}
                when: {over_limit: memory, for: 30s}
              docked:
                applications: navigation.yaml
                when: {host_lost: robot-2}
            """
        )
    )
    assert exploring.applications == ("navigation", "mapping")
    (planner, _), (mapper,) = (target.specs for target in exploring.targets)
    assert planner.parameters == {"speed": 0.5, "frame.id": "odom"}
    assert mapper.application == "mapping"
    assert exploring.limits == {"memory": 0.7}
    assert exploring.weights == {"memory": 1.0, "cpu": 0.2}
    assert (exploring.when, docked.when) == (Trigger("", "memory", 30.0), Trigger("robot-2"))
    assert docked.targets[0].specs[0].parameters["speed"] == 1.0


def test_the_parameters_of_a_mode_override_a_list_of_parameters(file, tmp_path) -> None:
    """Also those of a parameters file on the host that names the node."""
    section = "/nav/planner: {ros__parameters: {speed: 2.0, frame: {id: base}, rate: 5}}"
    path = tmp_path / "robot.params.yaml"
    path.write_text(section, encoding="utf-8")
    (tmp_path / "navigation.yaml").write_text(
        "app: navigation\nprocesses:\n  - name: planner\n    namespace: /nav\n    package: nav\n"
        f"    executable: planner\n    parameters: [{{speed: 1.0}}, {path}]\n",
        encoding="utf-8",
    )
    (mode,) = load_modes(
        file(
            """
            modes:
              slow:
                applications: navigation.yaml
                parameters: {planner: {speed: 0.5, frame: {id: odom}}}
            """
        )
    )
    ((planner,),) = (target.specs for target in mode.targets)
    found = all_parameters(planner)["/nav/planner"]
    assert found == {"speed": 0.5, "frame.id": "odom", "rate": 5}


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("modes: {}", "modes: a mapping of at least one mode is required"),
        ("modes: {a: navigation.yaml}", "a: a mapping is required, such as `a: {applications:"),
        ("modes: {a: {}}", "applications: is missing"),
        ("modes: {a: {applications: []}}", "applications: give at least one file"),
        ("modes: {a: {application: [x]}}", "did you mean 'applications'?"),
        ("modes: {a b: {applications: [navigation.yaml]}}", "'a b'"),
        ("modes: {a: {applications: [none.yaml]}}", "none.yaml"),
        (
            "modes: {a: {applications: [navigation.yaml, navigation.yaml]}}",
            "two files have the application 'navigation'",
        ),
        (
            "modes: {a: {applications: [navigation.yaml, other.yaml]}}",
            "navigation and other both have a process 'logger'; names are unique",
        ),
        (
            "modes: {a: {applications: [navigation.yaml], parameters: {planer: {x: 1}}}}",
            "no application of the mode has a process 'planer'; did you mean 'planner'?",
        ),
        (
            "modes: {a: {applications: [navigation.yaml], parameters: {logger: {x: 1}}}}",
            "logger is no ROS node",
        ),
        ("modes: {a: {applications: [navigation.yaml], limits: {memory: 2}}}", "memory"),
        (
            "modes: {a: {applications: [navigation.yaml], when: {}}}",
            "when: one condition is required, such as `when: {host_lost: robot-2}`",
        ),
        (
            "modes: {a: {applications: [navigation.yaml], when: {host_lost: b, for: 3s}}}",
            "for: goes with over_limit only",
        ),
        (
            "modes: {a: {applications: [navigation.yaml], when: {over_limit: cpu, fro: 3s}}}",
            "when: unknown key 'fro'; did you mean 'for'?",
        ),
        (
            "modes: {a: {applications: [navigation.yaml], when: {over_limit: cpu, for: 3 kg}}}",
            "when.for: ",
        ),
    ],
)
def test_a_wrong_mode_is_refused_with_its_place(refusal, text: str, error: str) -> None:
    """Each message names the key, and what is allowed."""
    said = refusal(load_modes, text)
    assert error in said
    assert ".yaml:" in said or "none.yaml" in said
