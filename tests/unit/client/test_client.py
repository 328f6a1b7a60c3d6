"""Client in a program: accepted arguments, waits and iterators."""

from __future__ import annotations

import pytest

from rosrm import Client, ConfigError, NoMaster, ProcessSpec, Refused, RosSettings
from tests.unit.cli.conftest import FakeClient, event, host, process


@pytest.fixture
def master():
    return FakeClient()


@pytest.fixture
def notes():
    return []


@pytest.fixture
def client(master, notes, monkeypatch):
    """Return a client whose looks follow each other at once."""
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    with Client(connection=master, notify=notes.append) as client:
        yield client
    assert master.closed


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"domain": 500}, "the ROS domain 500 is not a whole number from 0 to 232"),
        ({"domain": -1}, "the ROS domain -1 is not a whole number"),
        ({"domain": "7"}, "the ROS domain '7' is not a whole number"),
        ({"ros": RosSettings(domain=7, namespace="lab")}, "'lab' is not an absolute ROS namespace"),
    ],
)
def test_settings_that_ros_cannot_use_are_refused(settings, message):
    """DDS would end the program of a user whose domain is too high."""
    with pytest.raises(ConfigError, match=message):
        Client(timeout=0.1, **settings)


def test_submit_takes_files_mappings_and_specs(client, master, tmp_path):
    """One or several arguments, in their order, form one submission."""
    path = tmp_path / "work.yaml"
    path.write_text("processes: [{name: a, command: x}, {name: b, command: x}]", encoding="utf-8")
    mapping = {"name": "c", "command": ["x"], "needs": {"memory": "1GiB"}}
    spec = ProcessSpec("d", command=("x",))
    for work in (path, str(path), {"processes": [mapping]}, mapping, spec):
        client.submit(work)
    client.submit([path, mapping, spec])
    assert ["".join(names) for _, names in master.asked] == ["ab", "ab", "c", "c", "d", "abcd"]


@pytest.mark.parametrize(
    ("work", "message"),
    [
        ({"name": "a", "comand": "x"}, r"process 'a': unknown key 'comand'; did you mean 'comma"),
        ({"processes": []}, "work: processes: a list of at least one process is required"),
        ({"name": "a", "command": {1}}, r"process 'a': \{1\} is a set. Allowed: mappings with tex"),
        ("nowhere.yaml", "nowhere.yaml: cannot be read"),
    ],
)
def test_wrong_work_is_refused_before_it_is_sent(client, master, work, message):
    with pytest.raises(ConfigError, match=message):
        client.submit([{"name": "good", "command": ["x"]}, work])
    assert master.asked == []


def test_a_name_may_stand_alone(client, master):
    client.cancel("a")
    client.restart(name for name in ("a", "b"))
    client.prune(hosts="beta")
    assert master.asked == [("cancel", ["a"]), ("restart", ["a", "b"]), ("prune", [], ["beta"])]


def test_an_unknown_name_is_refused_with_the_nearest(client, master):
    for get in (client.get_process, client.get_host):
        with pytest.raises(Refused, match=r"did you mean '(alpha|talker)'"):
            get("alpah" if get == client.get_host else "takler")
    assert client.get_process("talker").state == "running"
    assert client.get_host("alpha").state == "up"


def test_events_follow_until_their_time_out(client, master, monkeypatch):
    """Each event comes once; a master that is silent for a while gets another request."""
    looks = iter([None, NoMaster("no answer."), event(3), None])

    def later(seconds):
        look = next(looks, None)
        master.fails = look if isinstance(look, NoMaster) else None
        if look is not None and master.fails is None:
            master.events.append(look)

    monkeypatch.setattr("time.sleep", later)
    following = client.events(follow=True, timeout=0.2)
    assert [one.sequence for one in following] == [1, 2, 3]


def test_followed_events_are_complete(client, master, monkeypatch):
    """More events than one listing has by default may follow between two requests."""
    many = [event(number) for number in range(3, 2003)]

    def later(seconds):
        master.events += many
        many.clear()

    monkeypatch.setattr("time.sleep", later)
    following = client.events(follow=True, timeout=0.2)
    assert [one.sequence for one in following] == list(range(1, 2003))


@pytest.mark.parametrize("process", ["", "talker"])
@pytest.mark.parametrize("kept", [1, 3])
@pytest.mark.parametrize("number", [1, 2, 6])
def test_followed_events_after_a_journal_gap_are_complete(
    client, master, monkeypatch, process, kept, number
):
    """New events have the sequences of lost ones, which the follower has seen."""
    master.events = [event(one) for one in range(1, 5)]
    news = [event(kept + 1 + one, message=f"new {one}") for one in range(number)]

    def later(seconds):
        master.events = master.events[:kept] + news

    monkeypatch.setattr("time.sleep", later)
    following = list(client.events(process=process, follow=True, timeout=0.2))
    assert following == [event(one) for one in range(1, 5)] + news
    again = client.events(process=process, after=kept + number, follow=True, timeout=0.1)
    assert list(again) == []


def test_followed_events_of_one_process_after_a_journal_gap_are_complete(
    client, master, monkeypatch
):
    """The newest event that the journal still has is of another process."""
    master.events = [event(1), event(2, process="other"), event(3, process="other"), event(4)]
    news = [event(3, message="new"), event(4, process="other"), event(5, message="newer")]
    looks = iter([master.events])

    def later(seconds):
        master.events = next(looks, master.events[:2] + news)

    monkeypatch.setattr("time.sleep", later)
    following = list(client.events(process="talker", follow=True, timeout=0.2))
    assert following == [event(1), event(4), news[0], news[2]]


@pytest.mark.parametrize("number", [1, 2, 6])
def test_a_wait_sees_its_end_also_after_a_journal_gap(client, master, monkeypatch, number):
    """The new events have sequences up to that of the request, which the master has lost."""
    master.events = [event(one) for one in range(1, 5)]
    master.processes = [process("a", "migrating")]
    master.hosts = [host("alpha", draining=True)]
    ends = [
        event(3, "master_started"), event(4, "migrated", process="a"),
        event(5, "host_drained", process="", host="alpha"),
        *(event(6 + one) for one in range(number)),
    ]  # fmt: skip

    def later(seconds):
        master.events = master.events[:2] + ends
        master.hosts = [host("alpha", draining=True, drained=True)]

    monkeypatch.setattr("time.sleep", later)
    assert client.wait_for_migration("a", after=4, timeout=5.0).event == ends[1]
    master.events = [event(one) for one in range(1, 5)]
    master.hosts = [host("alpha", draining=True)]
    assert client.wait_for_drain("alpha", after=4, timeout=5.0).event == ends[2]


def test_events_that_are_not_followed_do_not_wait_for_a_master(client, master):
    master.fails = NoMaster("no answer")
    with pytest.raises(NoMaster):
        list(client.events(timeout=60.0))


def test_a_silent_master_is_noted_once(client, master, notes):
    master.fails = NoMaster("no answer.")
    with pytest.raises(NoMaster):
        client.wait("talker", timeout=0.05)
    assert notes == ["no answer. Asking again until the master answers"]


def test_a_silence_of_the_master_is_noted_after_two_seconds(client, master, notes):
    """Followed events and waits need not fail first; each silence is noted once, with its end."""
    master.waits = (0.5, 2.1, 2.2, 9.0)
    next(client.events(follow=True))
    silence = "the master has not answered for 2 s; still waiting"
    assert notes == [silence, "the master answers again"]


def test_a_wait_says_why_it_is_not_done(client, master):
    """The error names processes that are pending, failed or no longer listed."""
    master.processes = [process("a", "starting"), process("b", "failed"), process("c")]
    seen = []
    result = client.wait(["a", "b", "c", "d"], timeout=0.05, on_change=seen.append)
    assert not result
    assert (result.pending, result.failed, result.missing) == (["a"], ["b"], ["d"])
    assert (result.timed_out, [row.name for row in result.processes]) == (True, ["a", "b", "c"])
    assert [row.name for row in seen] == ["a", "b"]


def test_a_wait_for_a_drain_has_the_processes_that_stayed(client, master):
    master.hosts = [host("alpha", draining=True, drained=True)]
    master.processes = [process("driver")]
    result = client.wait_for_drain("alpha", after=0)
    assert (result.done, [row.name for row in result.processes]) == (False, ["driver"])
    assert result.message == "alpha is drained"


def test_a_wait_for_a_migration_ends_after_its_time(client, master):
    master.processes = [process("a", "migrating")]
    result = client.wait_for_migration("a", after=2, timeout=0.05)
    assert (result.done, result.timed_out, result.pending) == (False, True, ["a"])
