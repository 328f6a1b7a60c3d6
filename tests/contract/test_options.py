"""Options of every shipped plugin: checked, converted to JSON and read back."""

import json
from types import MappingProxyType

import pytest
from pydantic import TypeAdapter, ValidationError

from rosrm.model.codec import from_plain, to_plain
from rosrm_checkpoint.plugin import register_checkpoint_policies
from rosrm_criu.plugin import register_migration_strategies as register_criu
from rosrm_migration.plugin import register_migration_strategies
from rosrm_resources.plugin import register_probes
from rosrm_scoring.plugin import register_scoring_policies

#: By name; a scoring policy with the name of a probe has another key.
OFFERS = {
    **{f"{offer.name} (scoring)": offer for offer in register_scoring_policies()},
    **{
        offer.name: offer
        for offer in [
            *register_scoring_policies(),
            *register_probes(),
            *register_migration_strategies(),
            *register_criu(),
            *register_checkpoint_policies(),
        ]
    },
}


@pytest.mark.parametrize("name", OFFERS)
def test_defaults_survive_the_way_to_the_slave(name):
    """Options checked by the client reach the slave unchanged."""
    options = OFFERS[name].options
    plain = json.loads(json.dumps(to_plain(options())))
    checked = TypeAdapter(options).validate_python(plain)
    assert to_plain(checked) == plain
    assert to_plain(from_plain(options, plain)) == plain


@pytest.mark.parametrize(
    ("name", "given", "what"),
    [
        ("cpu", {"scope": "container"}, "machine"),
        ("cpu", {"window": 0}, "greater than 0"),
        ("disk", {"walk_period": -1}, "greater than 0"),
        ("gpu", {"devices": [-1]}, "is not within 0"),
        ("gpu", {"combine": "sum"}, "'max' or 'mean'"),
        ("network", {"capacity": 0}, "greater than 0"),
        ("network (scoring)", {"round_trip": 0}, "greater than 0"),
        ("network (scoring)", {"local": 2.0}, "less than or equal to 1"),
        ("weighted", {"weights": {"cpu": 1.5}}, "less than or equal to 1"),
        ("handoff", {"ready_timeout": 0}, "greater than 0"),
        ("handoff", {"protocol": "mine"}, "'rosrm' or 'paper'"),
        ("handoff", {"protocol": "paper"}, "names the topic on which the node publishes"),
        ("handoff", {"protocol": "paper", "state": "/s", "type": "Int64"}, "std_msgs/msg/Int64"),
        ("handoff", {"state": "/s"}, "go with `protocol: paper`"),
        ("criu", {"max_rate": -1}, "-1"),
        ("criu", {"max_rate": "fast"}, "fast"),
        ("criu", {"leave_timeout": 0}, "greater than 0"),
        ("other-host", {"every": 0}, "greater than 0"),
        ("other-host", {"copies": 0}, "is not within 1"),
        ("threshold", {"enter": 0.5, "leave": 0.6}, r"leave \(0.6\) must be below enter \(0.5\)"),
    ],
)
def test_nonsense_is_refused(name, given, what):
    """The error lists the allowed values."""
    with pytest.raises(ValidationError, match=what):
        TypeAdapter(OFFERS[name].options).validate_python(given)


def test_default_weights_cannot_be_changed():
    """All policies share the default weights, so the mapping is read-only."""
    assert isinstance(OFFERS["weighted"].options().weights, MappingProxyType)
