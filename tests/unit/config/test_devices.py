"""Devices in `host.yaml` and `work.yaml`."""

from __future__ import annotations

import pytest

from rosrm.config.host import load_host
from rosrm.config.settings import HostConfig
from rosrm.config.work import load_work
from rosrm.model.devices import Device, DeviceNeed


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ("{gpu: [0, 1]}", (Device("gpu", "0"), Device("gpu", "1"))),
        ("{gpu: []}", ()),
        ("{camera: {front: /dev/video0}}", (Device("camera", "front", "/dev/video0"),)),
        ("{imu: /dev/ttyUSB0}", (Device("imu", "imu", "/dev/ttyUSB0"),)),
        ("{lidar: {shareable: 4}}", (Device("lidar", "lidar", shareable=4),)),
        (
            "{camera: {a: /dev/a, b: null, shareable: 2}}",
            (Device("camera", "a", "/dev/a", 2), Device("camera", "b", "", 2)),
        ),
    ],
)
def test_devices_of_a_host(file, section, expected):
    """Each form gives units with their kind; a single unit has the name of its kind."""
    config = load_host(file(f"devices: {section}"))
    assert tuple(one for units in config.devices.values() for one in units) == expected
    assert HostConfig.from_json(config.to_json()) == config


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("{gpu: [0, 0]}", "f.yaml:1:16: devices: gpu 0 is given twice"),
        ("{camera: {a: x, a: y}}", "the key 'a' is given twice"),
        ("{camera: {front: video0}}", "'video0' is no absolute path, such as /dev/video0"),
        ("{camera: {front: 7}}", "devices.camera: 7: the path of a device is required"),
        ("{gpu: 2}", "devices.gpu: 2: a list of units such as [0, 1], a mapping such as"),
        ("{gpu: {shareable: 0}}", "gpu: shareable is 0; allowed: 1 to 1000"),
        ("{gpu: {shareable: 1.5}}", "shareable: a whole number of processes is required, not 1.5"),
        ("{gpu: [../x]}", "gpu: '../x' cannot be a unit. Allowed: at most 64 letters"),
        ("{g/u: [0]}", "'g/u' cannot be a kind of devices. Allowed: at most 64 letters"),
        ("[gpu]", "devices: a mapping is required, not a list"),
    ],
)
def test_devices_that_no_host_can_have_are_refused(refusal, section, said):
    """The error names the device, and what is allowed."""
    assert said in refusal(load_host, f"devices: {section}")


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ("{gpu: 1, camera: front}", (DeviceNeed("gpu"), DeviceNeed("camera", 1.0, ("front",)))),
        ("{gpu: 0.5}", (DeviceNeed("gpu", 0.5),)),
        ("{camera: [front, rear]}", (DeviceNeed("camera", 2.0, ("front", "rear")),)),
        ("{gpu: [0]}", (DeviceNeed("gpu", 1.0, ("0",)),)),
    ],
)
def test_devices_of_a_process(file, section, expected):
    """A number counts units, and a name is that of a unit."""
    (spec,) = load_work(file(f"processes: [{{name: a, command: x, devices: {section}}}]"))
    assert spec.devices == expected


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("{gpu: 0}", "devices: gpu: 0.0 is not within 0.001..256"),
        ("{gpu: -1}", "devices: gpu: -1.0 is not within"),
        ("{gpu: 0.0005}", "devices: gpu: 0.0005 is not within 0.001..256"),
        ("{gpu: 1.5}", "gpu: 1.5 is neither a whole number of units nor a share of one unit"),
        ("{gpu: 1e9}", "is not within 0.001..256"),
        ("{gpu: .nan}", "devices: gpu: nan is not within 0.001..256"),
        ("{gpu: .inf}", "devices: gpu: inf is not within"),
        (f"{{gpu: 1{400 * '0'}}}", "devices: gpu: inf is not within"),
        ("{gpu: true}", "devices.gpu: True: a number such as 1 or 0.5, the name of a unit"),
        ("{gpu: []}", "devices.gpu: []: a number such as 1 or 0.5, the name of a unit"),
        ("{camera: [a, a]}", "camera: a unit is given twice: a, a"),
        ("{camera: ../x}", "camera: '../x' cannot be a unit"),
        ("{g/u: 1}", "'g/u' cannot be a kind of devices"),
        ("gpu", 'devices: a mapping is required, not "gpu"'),
    ],
)
def test_devices_that_no_process_can_ask_for_are_refused(refusal, section, said):
    """A share above one unit, a number that is none, or a unit that is given twice."""
    text = f"processes: [{{name: a, command: x, devices: {section}}}]"
    assert said in refusal(load_work, text)


def test_a_placeholder_of_a_device_that_the_process_does_not_ask_for_is_refused(refusal):
    """Otherwise the placeholder would reach the program as text."""
    text = """
        processes:
          - {name: a, command: x, arguments: ["{device.gpu}"], devices: {camera: 1}}
        """
    said = "arguments: {device.gpu} needs a device of the kind 'gpu', which the process does not"
    assert said in refusal(load_work, text)
    assert "its `devices:` are camera" in refusal(load_work, text)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("{device.gpus}", "its `devices:` are gpu; did you mean {device.gpu}?"),
        ("{devices.gpu}", "{devices.gpu} is unknown; did you mean {device.gpu}? Allowed: {artif"),
        ("{artifact}", "{artifact} is unknown; did you mean {artifacts}?"),
        ("{artefacts}/x", "{artefacts} is unknown; did you mean {artifacts}?"),
        ("{artifacts}", "{artifacts} needs `artifacts:` in the process"),
    ],
)
@pytest.mark.parametrize("key", ["command", "arguments", "environment"])
def test_a_misspelt_placeholder_is_refused(refusal, key, word, said):
    """Otherwise the placeholder would reach the program as text."""
    value = f'{{X: "{word}"}}' if key == "environment" else f'[x, "{word}"]'
    keys = {"command": "x", key: value}
    entry = ", ".join(f"{name}: {item}" for name, item in keys.items())
    text = f"processes: [{{name: a, {entry}, devices: {{gpu: 1}}}}]"
    assert f"{key}: {word[:8]}" in refusal(load_work, text)
    assert said in refusal(load_work, text)


def test_a_misspelt_placeholder_of_a_component_is_refused(refusal):
    """Otherwise the placeholder would reach the component as text."""
    text = """
        processes:
          - {name: a, module: m, ros: true, devices: {camera: 1}, components: [
              {plugin: p, name: c, parameters: {source: "{device.camera}", map: "{artifacts}/m"}}]}
        """
    said = refusal(load_work, text)
    assert "components: {artifacts} needs `artifacts:` in the process" in said
    assert "{device.camera}" not in said


def test_other_braces_are_no_placeholders(file):
    """Shells, awk and formats of Python use braces, too."""
    words = ["{print $1}", "${HOME}", "{device}", "{x.y}", '{"artifact": 1}', "{}"]
    (spec,) = load_work(file(f"processes: [{{name: a, command: {['x', *words]!r}}}]"))
    assert spec.command == ("x", *words)


def test_foreach_leaves_placeholders_to_the_host(file):
    """Values of `foreach` are filled in around them."""
    text = """
        processes:
          - name: "a{i}"
            foreach: {i: [1]}
            command: x
            arguments: ["{i}:{device.camera}", "{artifacts}/{i}"]
            devices: {camera: "top{i}"}
            artifacts: {x: x}
        """
    (spec,) = load_work(file(text), check_artifacts=False)
    assert spec.arguments == ("1:{device.camera}", "{artifacts}/1")
    assert spec.devices[0].units == ("top1",)
