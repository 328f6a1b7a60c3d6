"""Completeness of the reference pages: hooks, offers, settings, commands, JSON fields."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, get_args, get_origin, get_type_hints

import pytest
import typer.main

import rosrm
from rosrm.cli.command_tree import app
from rosrm.cli.groups import DISTRIBUTIONS
from rosrm.config.cluster import load_cluster
from rosrm.config.groups import GroupInFile
from rosrm.config.host import load_host
from rosrm.config.process import NeighboursInFile, ProcessInFile
from rosrm.config.rollout import RolloutInFile
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.config.work import load_work
from rosrm.extensions import contracts, hookspecs, installed
from rosrm.extensions.declared_fields import SPEC_FIELDS
from rosrm.extensions.discovery import HOOKS
from rosrm.model import plan
from rosrm.model.rows import EventRow, HostRow, PluginRow, ProcessRow, ResourceRow
from rosrm.model.values import Component, HostDescription
from rosrm_checkpoint.other_host import OtherHostOptions
from rosrm_criu.options import CriuOptions
from rosrm_migration.handoff import HandoffOptions
from rosrm_migration.relaunch import RelaunchOptions
from rosrm_scoring.threshold import ThresholdOptions
from rosrm_scoring.weighted import WeightedOptions
from tests.plugin_kit import HOOKS as OFFERS

REFERENCE = Path(__file__).resolve().parents[3] / "docs" / "reference"


def page(name: str) -> str:
    return (REFERENCE / name).read_text(encoding="utf-8")


def section(text: str, heading: str) -> str:
    """Return the text under a heading, up to the next one of its level or above."""
    found = re.search(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE)
    assert found, f"no section {heading!r}"
    rest = text[found.end() :]
    end = re.search(rf"^#{{1,{len(found[1])}}} ", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def keys(kind: type, before: str = "") -> Iterator[str]:
    """Yield the keys of a file by their dotted names, as in the dataclasses."""
    hints = get_type_hints(kind, include_extras=True)
    for f in fields(kind):
        hint = hints[f.name]
        marks = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        in_file = [mark.in_file() for mark in marks if hasattr(mark, "in_file")]
        members = get_args(hint) if get_origin(hint) is UnionType else ()
        members = (*members, *(get_args(in_file[0]) if in_file else ()))
        optional = [one for one in members if is_dataclass(one)]
        inner = (optional or in_file or [hint])[0]
        if is_dataclass(inner):
            yield from keys(inner, f"{before}{f.name}.")
        else:
            yield f"{before}{f.name}"


def rows(text: str) -> set[str]:
    """Return the first column of the tables of a text."""
    return set(re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE))


@pytest.mark.parametrize(
    ("heading", "kind"), [("`cluster.yaml`", ClusterConfig), ("`host.yaml`", HostConfig)]
)
def test_every_setting_is_documented_and_nothing_else(heading, kind):
    text = page("configuration.md")
    wanted = set(keys(kind))
    ros = {key for key in wanted if key.startswith("ros.")}
    assert rows(section(text, heading)) == wanted - ros | {"ros"}
    assert rows(section(text, "The section `ros`")) == ros


def test_every_option_of_the_checkpoint_policy_is_documented():
    text = section(page("configuration.md"), "Options of the checkpoint policy")
    named = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    assert named == {field.name for field in fields(OtherHostOptions)}


@pytest.mark.parametrize(
    ("heading", "options"),
    [
        ("scoring policies", WeightedOptions), ("scoring policies", ThresholdOptions),
        ("strategies", RelaunchOptions), ("strategies", HandoffOptions),
        ("strategies", CriuOptions),
    ],
)  # fmt: skip
def test_every_option_of_a_policy_and_a_strategy_is_documented(heading, options):
    """Each shipped one has a table with all its options."""
    text = section(page("configuration.md"), f"Options of the {heading}")
    name = options.__name__.removesuffix("Options").lower()
    table = text[text.index(f"| `{name}` | default |") :].split("\n\n")[0]
    named = {word for cell in re.findall(r"^\| ([^|]+) \|", table, re.MULTILINE)
             for word in re.findall(r"`(\w+)`", cell)}  # fmt: skip
    assert named - {name} == {field.name for field in fields(options)}


def test_every_key_of_a_process_is_documented_and_nothing_else():
    wanted = set(keys(ProcessInFile)) | {"foreach", "processes", "defaults"}
    wanted |= {"restart", "migration", "readiness", "stop"}
    wanted |= {
        "host_loss",
        "isolation",
        "standby",
        "health",
        "lifecycle",
        "components",
        "spread",
        "reschedule",
    }
    wanted |= {"limits", "realtime", "container", "after.delay", "after.on_restart"}
    wanted |= {"group", *keys(GroupInFile, "group.")}
    wanted |= {"app", "rollout", *keys(RolloutInFile, "rollout.")}
    members = [field.name for field in fields(NeighboursInFile)]
    wanted |= {f"{key}.{member}" for key in ("near", "apart") for member in members}
    wanted |= set(keys(Component, "components."))
    assert rows(section(page("configuration.md"), "`work.yaml`")) == wanted


@pytest.fixture
def marked(tmp_path):
    """Return a function that saves the YAML block with a mark; its result is text and file."""

    def save(mark):
        text = page("configuration.md")
        block = re.search(rf"<!-- {mark} -->\n```yaml\n(.*?)```", text, re.DOTALL)
        (tmp_path / "f.yaml").write_text(block[1], encoding="utf-8")
        return block[1], tmp_path / "f.yaml"

    return save


@pytest.mark.parametrize(
    ("mark", "load", "defaults"),
    [("cluster", load_cluster, ClusterConfig()), ("host", load_host, HostConfig())],
)
def test_the_defaults_in_the_page_are_the_defaults(mark, load, defaults, marked):
    """The example has every key but the host's name, which is the machine's."""
    text, file = marked(f"defaults: {mark}")
    assert load(file) == defaults
    for key in keys(type(defaults)):
        name = key.rsplit(".", 1)[-1]
        assert key == "host" or re.search(rf"\b{name}:", text), f"{key} is not in the example"


def test_the_work_file_in_the_page_is_right(marked):
    assert len(load_work(marked("work")[1])) == 22


def hook_names() -> list[str]:
    return [
        name
        for name, function in vars(hookspecs).items()
        if callable(function) and hasattr(function, f"{installed.GROUP}_spec")
    ]


def test_the_loader_knows_every_hook():
    assert sorted(hook_names()) == sorted(HOOKS)


@pytest.mark.parametrize("hook", hook_names())
def test_every_hook_and_its_parameters_are_documented(hook):
    text = page("plugins.md")
    assert hook in rows(section(text, "Hooks"))
    for parameter in inspect.signature(getattr(hookspecs, hook)).parameters:
        assert f"`{parameter}`" in section(text, "Hooks")


@pytest.mark.parametrize("offer", OFFERS, ids=lambda offer: offer.__name__)
def test_every_field_of_an_offer_is_documented(offer):
    text = page("plugins.md")
    common = section(text, "Offers").split("\n### ")[0]
    own = section(text, f"`{offer.__name__}`")
    for f in fields(offer):
        assert f"- `{f.name}`" in common + own, f"{offer.__name__}.{f.name}"


@pytest.mark.parametrize(
    ("offer", "kinds"),
    [
        ("Probe", [contracts.Probe, contracts.HostLabelling, contracts.ProbeContext,
                   contracts.Sessions]),
        ("Scoring", [contracts.ScoringPolicy, contracts.HostView, contracts.ProcessView,
                     contracts.Scores]),
        ("Filter", [contracts.PlacementFilter]),
        ("Migration", [contracts.MigrationStrategy, plan.Move, plan.Plan]),
        ("Checkpoint", [contracts.CheckpointPolicy, contracts.CheckpointView,
                        contracts.CheckpointChoice]),
    ],
)  # fmt: skip
def test_all_that_a_plugin_meets_is_documented(offer, kinds):
    text = section(page("plugins.md"), f"`{offer}Offer`")
    for kind in kinds:
        assert kind.__name__ in text or kind is contracts.Sessions
        for name in set(vars(kind)) | set(getattr(kind, "__annotations__", ())):
            if not name.startswith("_"):
                assert re.search(rf"`{name}[`(]", text), f"{kind.__name__}.{name}"


def test_every_step_of_a_plan_is_public_and_its_arguments_are_documented():
    text = " ".join(section(page("plugins.md"), "`MigrationOffer`").split())
    for step in get_args(plan.Step):
        assert getattr(rosrm, step.__name__) is step
        assert step.__name__ in rosrm.__all__
        shown = re.search(rf"`{step.__name__}\(([^`]*)\)`", text)
        names = [f.name for f in fields(step) if (step, f.name) not in _OF_NO_USE]
        assert re.findall(r"(\w+)(?:=[^,]+)?(?:,|$)", shown[1]) == names


def test_every_field_of_a_spec_that_a_policy_may_read_is_documented():
    text = section(page("plugins.md"), "`ScoringOffer`")
    assert {name for name in SPEC_FIELDS if f"`{name}`" not in text} == set()


#: A commit takes no time and cannot be undone.
_OF_NO_USE = {(plan.Commit, "timeout"), (plan.Commit, "undo")}


def commands(group, before: str = "rosrm") -> Iterator[tuple[str, object]]:
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        if hasattr(command, "commands"):
            yield from commands(command, f"{before} {name}")
        else:
            yield f"{before} {name}", command


TREE = typer.main.get_command(app)


@pytest.mark.parametrize(("name", "command"), list(commands(TREE)), ids=str)
def test_every_command_and_option_is_documented(name, command):
    text = section(page("command-line.md"), f"`{name}`")
    for parameter in command.params:
        for word in parameter.opts if parameter.param_type_name == "option" else ():
            assert re.search(rf"`{word}\b", text), f"{name} {word}"
        if parameter.param_type_name == "argument":
            assert str(parameter.metavar) in text, f"{name} {parameter.metavar}"


def test_nothing_is_documented_that_is_no_command():
    """Commands of a distribution that is not installed here cannot be compared."""
    absent = set(DISTRIBUTIONS) - set(TREE.list_commands(None))
    documented = set(re.findall(r"^### `(rosrm [^`]+)`$", page("command-line.md"), re.MULTILINE))
    installed = {name for name in documented if name.split()[1] not in absent}
    assert installed == {name for name, _ in commands(TREE)}


def test_the_common_options_are_documented():
    text = page("command-line.md").split("\n## ")[0]
    for parameter in TREE.params:
        for word in parameter.opts:
            assert f"`{word}`" in text, word


@pytest.mark.parametrize(
    ("title", "kinds"),
    [
        ("A process", [ProcessRow]), ("A host", [HostRow, HostDescription, ResourceRow]),
        ("An event", [EventRow]), ("A plugin", [PluginRow]),
    ],
)  # fmt: skip
def test_every_field_of_the_json_is_documented(title, kinds):
    text = f"{page('command-line.md')}\n"
    found = re.search(rf"^\*\*{title}\*\*.*?\n\n", text, re.MULTILINE | re.DOTALL)
    for kind in kinds:
        for f in fields(kind):
            if f.name != "description":  # fields of a host are documented beside the others
                assert f"`{f.name}`" in found[0], f"{kind.__name__}.{f.name}"


def test_the_protocol_page_has_the_protocol_version():
    """The page and `PROTOCOL_VERSION` name one version."""
    assert f"This is protocol version {rosrm.PROTOCOL_VERSION}." in page("protocol.md")
