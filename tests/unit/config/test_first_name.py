"""A host without a name in its file keeps its name if its machine is renamed."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.config import first_name as module
from rosrm.config.first_name import keep_name
from rosrm.config.host import load_host
from rosrm.config.settings import HostConfig, place_of_name
from rosrm.errors import ConfigError
from rosrm.slave.runtime import SlaveRuntime


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A machine with a name and an id, which the test sets."""
    names = SimpleNamespace(host="first", id="1")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "states"))
    monkeypatch.setattr("socket.gethostname", lambda: names.host)
    monkeypatch.setattr(module, "_machine", lambda: names.id)
    return names


def started(settings: HostConfig) -> str:
    """Keep the name as the command does when it starts the slave; return what it says."""
    place = place_of_name(settings)
    place.mkdir(parents=True, exist_ok=True)
    return keep_name(place, settings.host)


@pytest.mark.parametrize("text", ["", "state: here"])
def test_a_renamed_machine_keeps_its_host(machine, file, text) -> None:
    """Host and state directory are those of the first start, and a note names the change."""
    first = load_host(file(text))
    assert (first.host, started(first)) == ("first", "")
    machine.host = "second"
    later = load_host(file(text))
    assert (later.host, later.state) == ("first", first.state)
    assert "is named 'second' now; its host keeps its first name 'first'" in started(later)


def test_a_name_in_the_file_is_the_name_of_the_host(machine, file) -> None:
    """The first name of the machine does not replace that name, and rosrm keeps no note of it."""
    started(HostConfig())
    machine.host = "second"
    assert load_host(file("host: second")).host == "second"
    assert started(load_host(file("{host: robot, state: there}"))) == ""
    assert load_host(file("state: there")).host == "second"


def test_a_name_that_cannot_be_read_now_is_not_replaced(machine, file) -> None:
    """With the present name of the machine, its processes would belong to a lost host."""
    started(load_host(file("")))
    machine.host = "second"
    (note,) = place_of_name(HostConfig(host="first")).glob(".host")
    note.rename(note.with_name("kept"))
    note.mkdir()  # reading it fails as with a disk that fails
    with pytest.raises(ConfigError, match=r"\.host, which has the name of this host"):
        load_host(file(""))
    note.rmdir()
    note.with_name("kept").rename(note)
    assert load_host(file("")).host == "first"


def test_a_copied_disk_does_not_copy_the_name(machine) -> None:
    """Two machines from one image would otherwise be one host."""
    started(HostConfig())
    machine.host, machine.id = "second", "2"
    assert HostConfig().host == "second"
    assert started(HostConfig()) == ""
    machine.host = "third"
    assert HostConfig().host == "second"


def test_a_running_slave_reports_the_new_name_of_its_machine(machine) -> None:
    """Commands on the machine find the host that runs there by this name."""
    described = []
    runtime = SimpleNamespace(
        _config=SimpleNamespace(host="first"), _description=lambda: "again",
        _endpoint=SimpleNamespace(
            description=SimpleNamespace(hostname="first"), describe_again=described.append
        ),
    )  # fmt: skip
    SlaveRuntime._look_at_name(runtime)
    machine.host = "second"
    SlaveRuntime._look_at_name(runtime)
    assert described == ["again"]
