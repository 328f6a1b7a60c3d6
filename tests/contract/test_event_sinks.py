"""Every shipped event sink holds the contract that a third party's holds."""

import json
from contextlib import closing

import pytest
from mcap.reader import make_reader

from rosrm import RosrmError
from rosrm.testing import EventSinkContract
from rosrm_alerts import plugin
from rosrm_alerts.sinks.command import Command, CommandOptions
from rosrm_alerts.sinks.webhook import Webhook
from rosrm_alerts.sinks.webhook_options import WebhookOptions
from tests.webhook_kit import Receiver

OFFERS = {offer.name: offer for offer in plugin.register_event_sinks()}


class TestWebhook(EventSinkContract):
    offer = OFFERS["webhook"]

    @pytest.fixture(autouse=True)
    def _receiver(self):
        with Receiver() as self.receiver:
            yield

    def options(self):
        return {"url": self.receiver.url}

    def received(self):
        return [one["id"] for one in self.receiver.notices]


class TestCommand(EventSinkContract):
    offer = OFFERS["command"]

    @pytest.fixture(autouse=True)
    def _file(self, tmp_path):
        self.file = tmp_path / "lines"

    def options(self):
        # Each notice is one line of JSON on the standard input.
        return {"command": ["sh", "-c", f"cat >> {self.file}; echo >> {self.file}"]}

    def received(self):
        return [json.loads(line)["id"] for line in self.file.read_text().splitlines()]


class TestMcapFile(EventSinkContract):
    offer = OFFERS["mcap"]

    @pytest.fixture(autouse=True)
    def _file(self, tmp_path):
        self.file = tmp_path / "events.mcap"

    def options(self):
        return {"file": str(self.file)}

    def received(self):
        with self.file.open("rb") as stream:
            messages = list(make_reader(stream).iter_messages())
        assert {(schema.name, channel.topic) for schema, channel, _ in messages} == {
            ("foxglove.Log", "/rosrm/events")
        }
        return [json.loads(message.data)["id"] for _, _, message in messages]

    def test_no_other_user_may_read_the_file(self):
        """Its events name the processes of all users."""
        with closing(self.make()):
            assert self.file.stat().st_mode & 0o777 == 0o600


def test_each_shipped_sink_is_here():
    """A sink that is added to the plugin must be added here."""
    tested = {contract.offer.name for contract in EventSinkContract.__subclasses__()}
    assert set(OFFERS) <= tested


def test_an_argument_of_a_command_holds_the_values_of_the_notice(tmp_path):
    """No shell reads them, and braces in a value are not replaced again."""
    file = tmp_path / "out"
    sink = Command(
        CommandOptions(("sh", "-c", f'echo "$1" > {file}', "x", "{kind} of {process}: {message}"))
    )

    sink.send(EventSinkContract().notices()[1:2])

    assert file.read_text().splitlines() == [
        'failed of nav/p: a "quoted" <b>name</b>; $(true) h', "second line \N{SNOWMAN}"
    ]  # fmt: skip


def test_a_command_that_fails_is_a_failure_with_its_last_line():
    """So that the notice is sent again."""
    sink = Command(CommandOptions(("sh", "-c", "echo first >&2; echo no horn >&2; exit 3")))

    with pytest.raises(RosrmError, match="sh: exit code 3: no horn"):
        sink.send(EventSinkContract().notices()[:1])


def test_headers_come_from_a_file(tmp_path):
    """So that a token is not in alerts.yaml."""
    (tmp_path / "headers").write_text("Authorization: Bearer secret\n\n")
    with Receiver() as receiver:
        sink = Webhook(WebhookOptions(receiver.url, str(tmp_path / "headers")))
        sink.send(EventSinkContract().notices()[:1])

    assert receiver.headers["Authorization"] == "Bearer secret"
