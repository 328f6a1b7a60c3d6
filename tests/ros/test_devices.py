"""Devices of real slaves: files stand for cameras."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.rows import DeviceRow
from rosrm.model.values import MigrationPolicy, ProcessSpec, RestartPolicy
from tests.ros.clusters import STEADY, host, service
from tests.waiting import wait_until

CAMERA = (DeviceNeed("camera"),)
#: A program that prints its argument and its devices.
SHOW = (
    "sh", "-c",
    'echo "$0 $ROSRM_DEVICE_CAMERA gpus:$CUDA_VISIBLE_DEVICES:"; exec sleep 1000',
)  # fmt: skip


#: A plugin whose probe finds a device for each file in a folder, and labels its host.
FINDER = """
from pathlib import Path
from rosrm import Device, ProbeOffer, Reading, ResourceDescription, hookimpl

HERE = Path(__file__).parent

class Finder:
    resources = [ResourceDescription("bays", "1", 2.0)]
    labels = {"bay.model": "X", "rack": "of the probe"}
    def __init__(self, options, context): pass
    def read(self): return [Reading("bays", 0.0)]
    def devices(self):
        there = {one.name for one in HERE.glob("bay*")}
        if "bay.broken" in there: raise RuntimeError("no bays")
        return [
            Device("bay", unit, missing="" if f"bay{unit}" in there else "empty") for unit in "01"
        ]
    def close(self): pass

@hookimpl
def register_probes():
    return [ProbeOffer("bays", Finder)]
"""


@pytest.fixture
def bays(tmp_path, monkeypatch):
    """Install the plugin, and return its folder."""
    (tmp_path / "finder.py").write_text(FINDER)
    info = tmp_path / "finder-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: finder\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rosrm]\nfinder = finder\n")
    before = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [before])]))
    monkeypatch.syspath_prepend(tmp_path)  # the starting process finds the plugin
    return tmp_path


def camera(directory: Path, unit: str) -> Device:
    """Return a camera whose file exists."""
    path = directory / f"video-{unit}"
    path.touch()
    return Device("camera", unit, str(path))


def viewer(name: str, **options) -> ProcessSpec:
    """Return a process that asks for a camera, and prints what it gets."""
    options.setdefault("devices", CAMERA)
    return service(name, *SHOW, arguments=("view={device.camera}",), **options)


def devices_of(cluster, name: str = "a") -> dict[str, DeviceRow]:
    rows = {row.description.name: row for row in cluster.client.list(hosts=True).hosts}
    return {one.title: one for one in rows[name].devices}


def waits_for(cluster, name: str, holder: str) -> None:
    """Wait until `rosrm explain` names the holder of the camera as the reason of a wait."""
    reason = f"camera front is held by {holder}#"
    wait_until(
        lambda: reason in str(cluster.client.explain(name)), f"{name} waits: {reason}",
        seen=lambda: cluster.client.explain(name), pause=cluster.client.spin,
    )  # fmt: skip


def test_a_device_is_given_to_one_process_which_knows_its_path(make_cluster, tmp_path) -> None:
    """Another process waits, also after restarts of master and slave, until the device is free."""
    front = camera(tmp_path, "front")
    gpus = (Device("gpu", "0"), Device("gpu", "1"))
    cluster = make_cluster(host("a", devices={"camera": (front,), "gpu": gpus}), liveness=STEADY)
    cluster.submit(viewer("first", devices=(*CAMERA, DeviceNeed("gpu", 2.0))))
    cluster.wait("first", "running")
    cluster.wait_for_log("first", f"view={front.path} {front.path} gpus:0,1:")
    cluster.submit(viewer("second"))
    waits_for(cluster, "second", "first")
    assert devices_of(cluster)["camera front"].free == 0.0

    cluster.restart_master()
    cluster.wait("first", "running")
    cluster.start_slave_again("a")
    cluster.wait("first", "running")
    assert devices_of(cluster)["camera front"].holders[0].startswith("first#")
    waits_for(cluster, "second", "first")

    cluster.cancel("first")
    cluster.wait("second", "running")
    cluster.wait_for_log("second", f"view={front.path} {front.path} gpus::")


def test_a_process_whose_device_vanishes_has_failed_and_follows_its_policy(
    make_cluster, tmp_path
) -> None:
    """While the file is gone the device is not offered; then the process runs again."""
    front = camera(tmp_path, "front")
    cluster = make_cluster(host("a", devices={"camera": (front,)}), liveness=STEADY)
    again = RestartPolicy("on-failure", delay=0.5, max_delay=0.5, attempts=1000)
    cluster.submit(viewer("restarted", restart=again))
    cluster.wait("restarted", "running")

    Path(front.path).unlink()
    cluster.wait_for_event("device_missing", "No such file or directory; restarted#1 holds it")
    failed = cluster.wait_for_event("backoff", process="restarted")
    assert f"unhealthy: camera front is missing: {front.path}: No such file" in failed.message
    assert devices_of(cluster)["camera front"].missing
    cluster.submit(viewer("next"))
    assert "camera front is missing" in cluster.wait("next", "set_aside").reason

    Path(front.path).touch()
    cluster.wait_for_event("device_found", "camera front on a is there again")
    cluster.wait("restarted", "running")
    waits_for(cluster, "next", "restarted")


def test_a_process_that_moves_gets_the_device_of_its_new_host(make_cluster, tmp_path) -> None:
    """The device of the former host is free as soon as the source is gone."""
    here, there = camera(tmp_path, "here"), camera(tmp_path, "there")
    cluster = make_cluster(
        host("a", devices={"camera": (here,)}), host("b", devices={"camera": (there,)}),
        liveness=STEADY,
    )  # fmt: skip
    cluster.submit(viewer("moves", migration=MigrationPolicy("relaunch", overlap=True)))
    first = cluster.wait("moves", "running").host
    before, after = (here, there) if first == "a" else (there, here)
    cluster.client.migrate("moves", None)
    cluster.wait("moves", "running", migrations=1)
    cluster.wait_for_log("moves", f"view={after.path}")
    wait_until(
        lambda: devices_of(cluster, first)[before.title].free == 1.0, "the source's camera is free",
        pause=cluster.client.spin,
    )  # fmt: skip


def test_a_probe_adds_devices_and_labels_to_its_host(make_cluster, bays) -> None:
    """Labels of the settings win; a device that the probe misses fails the process on it."""
    (bays / "bay0").touch()
    probes = {"memory": {}, "cpu": {}, "bays": {}}
    cluster = make_cluster(host("a", probes=probes, labels={"rack": "1"}), liveness=STEADY)
    wanted = {"bay.model": "X", "rack": "1"}
    bay = (DeviceNeed("bay"),)
    cluster.submit(service("first", devices=bay, required_labels=wanted))
    cluster.wait("first", "running")
    cluster.submit(service("second", devices=bay, restart=RestartPolicy("never")))
    (bays / "bay1").touch()
    cluster.wait("second", "running")
    assert {one.title: one.holders[0][:-1] for one in devices_of(cluster).values()} == {
        "bay 0": "first#", "bay 1": "second#",
    }  # fmt: skip
    (bays / "bay1").unlink()
    row = cluster.wait("second", "failed")
    assert row.reason.startswith("unhealthy: bay 1 is missing: empty")
    assert cluster.wait("first", "running").restarts == 0


def test_a_probe_that_finds_no_devices_any_more_ends_no_slave(make_cluster, bays) -> None:
    """The error is logged, the settings can be loaded again, and the processes run on."""
    (bays / "master.yaml").write_text("name: rosrm\n")
    (bays / "a.yaml").write_text("host: a\nprobes: [memory, cpu, bays]\nlabels: {bay: other}\n")
    probes = {"memory": {}, "cpu": {}, "bays": {}}
    cluster = make_cluster(host("a", probes=probes), started=False, liveness=STEADY)
    cluster.files = {"master": bays / "master.yaml", "a": bays / "a.yaml"}
    cluster.__enter__()
    (bays / "bay0").touch()
    cluster.submit(service("first", devices=(DeviceNeed("bay"),)))
    cluster.wait("first", "running")
    (bays / "bay.broken").touch()
    wait_until(lambda: "no bays" in cluster.log_of("a"), "the error is logged")
    assert "a: reloaded labels" in cluster.client.reload()
    assert cluster.wait("first", "running").restarts == 0
