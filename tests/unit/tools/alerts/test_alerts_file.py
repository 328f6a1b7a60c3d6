"""`alerts.yaml`: what is read, what is refused, and the tests that it has."""

import pytest

from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry
from rosrm_alerts import plugin
from rosrm_alerts.alerts_file import load_alerts
from rosrm_alerts.conditions import Above, Happens, HostLost, InState, NoAnswer
from rosrm_alerts.rehearsal import differences
from rosrm_resources import plugin as resources

REGISTRY = Registry.of(alerts=plugin, resources=resources)
WHOLE = """
sinks:
  chat: {use: webhook, url: https://example.com/hook, timeout: 500ms}
  horn: {use: command, command: [echo, "{message}"]}
events:
  - {to: chat, kinds: [host_lost, failed]}
alerts:
  gone: {when: {host_lost: "*"}, to: [chat, horn], level: ERROR}
  hot: {when: {above: {memory: 0.9}, host: robot-*, for: 30s}, to: chat}
  full: {when: {over_limit: memory}}
  loop: {when: {event: backoff, count: 3, within: 10min}}
  stuck: {when: {state: [queued, set_aside], application: nav, for: 5min}}
  silent: {when: {no_master: true, for: 10s}}
tests:
  - name: memory stays high
    steps:
      - {at: 0s, hosts: {robot-1: {usage: {memory: 0.95}}}}
      - {at: 40s, hosts: {robot-1: {usage: {memory: 0.5}}}}
      - {at: 50s, hosts: {robot-1: {state: lost}}}
    expect:
      - {at: 30s, begins: hot, about: robot-1}
      - {at: 40s, ends: hot, about: robot-1}
      - {at: 50s, begins: gone, about: robot-1}
"""


@pytest.fixture
def load(tmp_path):
    def loaded(text: str):
        path = tmp_path / "alerts.yaml"
        path.write_text(text)
        return load_alerts(path, REGISTRY)

    return loaded


def test_every_form_is_read(load):
    """All conditions, sinks with options in base units, and forwarded events."""
    file = load(WHOLE)

    assert [one.condition for one in file.alerts] == [
        HostLost("*"),
        Above("memory", 0.9, "robot-*"),
        Above("memory"),
        Happens(frozenset({"backoff"}), count=3, within=600.0),
        InState(frozenset({"queued", "set_aside"}), application="nav"),
        NoAnswer(),
    ]
    assert [one.lasts for one in file.alerts] == [0.0, 30.0, 0.0, 0.0, 300.0, 10.0]
    assert (file.alerts[0].to, file.alerts[0].level) == (("chat", "horn"), "ERROR")
    assert file.sinks[0].options["timeout"] == 0.5
    assert file.forwarded[0].kinds == ("host_lost", "failed")


def test_the_tests_of_a_file_run_without_a_cluster(load):
    """A test holds if exactly the expected alerts begin and end, at the expected times."""
    file = load(WHOLE)
    (test,) = file.tests

    assert differences(test, file.alerts) == []


def test_a_test_that_expects_something_else_fails(load):
    """The message names each difference with its time."""
    file = load(WHOLE.replace("at: 30s, begins", "at: 31s, begins"))

    assert differences(file.tests[0], file.alerts) == [
        "expected, and did not happen: hot begins on robot-1 at 31 s",
        "happened, and is not expected: hot begins on robot-1 at 30 s",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("- 1", "a mapping is required"),
        ("alert: {}", "unknown key 'alert'; did you mean 'alerts'?"),
        ("alerts: {a: {when: {event: faild}}}", "'faild' is unknown; did you mean 'failed'?"),
        ("alerts: {a: {to: x, when: {host_lost: h}}}", "no sink 'x' here"),
        ("alerts: {a: {when: {host_lst: h}}}", "exactly one of event, host_lost"),
        ("alerts: {a: {when: {host_lost: h, event: failed}}}", "exactly one of event, host_lost"),
        ("alerts: {a: {when: {host_lost: h, count: 2}}}", "unknown key 'count'"),
        ("alerts: {a: {when: {event: failed, for: 3s}}}", "an event has no duration"),
        ("alerts: {a: {when: {event: failed, count: 3}}}", "`count` and `within` go together"),
        ("alerts: {a: {when: {state: runing}}}", "did you mean 'running'?"),
        ("alerts: {a: {when: {above: {memroy: 0.9}}}}", "did you mean 'memory'?"),
        ("alerts: {a: {when: {above: {memory: 90}}}}", "a fraction: 0.8 means 80 %"),
        ("alerts: {a: {when: {no_master: false}}}", "the only value is `true`"),
        ("alerts: {a: {when: {host_lost: h, for: soon}}}", "when.for: 'soon' is not a number"),
        ("alerts: {a: 3}", "alerts.a: a mapping is required"),
        ("sinks: {a: {}}", "`use` is missing"),
        ("sinks: {a: {use: webhok, url: 'http://x/'}}", "did you mean 'webhook'?"),
        ("sinks: {a: {use: webhook, url: 'ftp://x/'}}", "is no address"),
        ("events: [{to: x}]", "events.0.to: no sink 'x' here"),
        ("sinks: {a: {use: command, command: [a]}}\nevents: [{to: a, kinds: [fail]}]", "no kind"),
        ("tests: [{name: t, steps: [{at: 0s, processes: {p: {state: up}}}]}]", "'up' is unknown"),
        ("tests: [{name: t, steps: [], expect: [{at: 0s, begins: b}]}]", "no alert 'b' here"),
        ("tests: [{name: t, steps: [], expect: [{at: 0s}]}]", "`begins: NAME` or `ends: NAME`"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(load, text, said):
    """A typo in a rule is refused, with the nearest word."""
    with pytest.raises(ConfigError) as error:
        load(text)

    assert said in str(error.value)
    assert "alerts.yaml:" in str(error.value)
