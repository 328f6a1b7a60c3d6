"""Examples in the documentation: files load, links resolve, commands and names exist."""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.main
import yaml
from typer.testing import CliRunner

from rosrm.cli.command_tree import app
from rosrm.cli.groups import DISTRIBUTIONS
from rosrm.extensions.registry import Registry
from rosrm.ros import names
from tests import pages

ROOT = Path(__file__).resolve().parents[3]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *ROOT.glob("*/README.md")])

TREE = typer.main.get_command(app)

_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> Iterator[tuple[str, str, str]]:
    """Yield mark, title and text of each fenced block of a language."""
    for found in pages.BLOCK.finditer(page.read_text(encoding="utf-8")):
        if found["language"] == language:
            yield found["mark"] or "", pages.title_of(found), found["text"]


# --- files ------------------------------------------------------------------------------------


FILES = [
    pytest.param(page, title, text, id=f"{name_of(page)}:{title}:{number}")
    for page in PAGES
    for number, (_, title, text) in enumerate(blocks(page, "yaml"))
    if title
]


@pytest.fixture(scope="module")
def registry() -> Registry:
    return Registry.discover()


@pytest.mark.parametrize(("page", "title", "text"), FILES)
def test_every_file_that_is_shown_is_right(page, title, text, tmp_path, monkeypatch, registry):
    """`rosrm config check FILE` accepts it, and finds its kind from keys or name.

    The artifacts that it names exist, and so do the other files of its page.
    """
    shown = {other: content for _, other, content in blocks(page, "yaml") if other}
    for name, content in {**shown, title: text}.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
        for process in yaml.safe_load(content).get("processes", ()):
            for path in process.get("artifacts", {}).values():
                (tmp_path / path).mkdir(parents=True, exist_ok=True)
    file = tmp_path / title
    monkeypatch.setattr(Registry, "discover", lambda: registry)
    done = CliRunner().invoke(app, ["config", "check", str(file)])
    assert done.exit_code == 0, done.exception
    assert f"{title}: ok" in done.output


def test_no_two_pages_have_clusters_of_one_name():
    """Their processes would mix in the journal, whose path is below the name."""
    used = {}
    for page in PAGES:
        for _, title, text in blocks(page, "yaml"):
            given = yaml.safe_load(text) if title.endswith("cluster.yaml") else {}
            if "state" not in given:
                used.setdefault(given.get("name"), set()).add(name_of(page))
    assert {name: where for name, where in used.items() if name and len(where) > 1} == {}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_yaml_block_says_what_it_is(page):
    """A title means that it is loaded here; a mark names another test that loads it."""
    unmarked = [text for mark, title, text in blocks(page, "yaml") if not (mark or title)]
    assert not unmarked


# --- programs ---------------------------------------------------------------------------------

PROGRAMS = [
    pytest.param(mark, text, id=f"{name_of(page)}:{mark}")
    for page in PAGES
    for mark, _, text in blocks(page, "python")
    if mark.endswith(".py") and not mark.startswith("file:")
]


@pytest.mark.parametrize(("mark", "text"), PROGRAMS)
def test_a_program_is_shown_as_it_is(mark, text):
    """The mark before it names the file, which other tests run."""
    assert text == (ROOT / mark).read_text(encoding="utf-8")


# --- links ------------------------------------------------------------------------------------


def links(page: Path) -> Iterator[str]:
    """Yield the relative links of a page, code left out."""
    text = pages.BLOCK.sub("", page.read_text(encoding="utf-8"))
    for target in _LINK.findall(re.sub(r"`[^`\n]*`", "`code`", text)):
        if not re.match(r"[a-z]+:", target):
            yield target


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    text = pages.BLOCK.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page):
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), link


def test_every_file_of_the_documentation_is_reached_from_its_index():
    reached, ahead = set(), [DOCS / "README.md"]
    while ahead:
        page = ahead.pop()
        if page in reached:
            continue
        reached.add(page)
        if page.suffix == ".md" and page.exists():
            ahead += [(page.parent / link.partition("#")[0]).resolve() for link in links(page)]
    files = (file for file in DOCS.rglob("*") if file.is_file())
    there = {file for file in files if file.parent.name != "__pycache__"}
    assert sorted(map(name_of, there - reached)) == []


# --- commands ---------------------------------------------------------------------------------


def shown_commands(page: Path) -> Iterator[list[str]]:
    """Yield the arguments of each `rosrm` command line in the console blocks of a page."""
    for _, _, text in blocks(page, "console"):
        for line in re.findall(r"^[\w-]*\$ (?:\w+=\S+ )*rosrm ([^#|\n]+)", text, re.MULTILINE):
            yield line.split()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_that_is_shown_exists(page):
    """Commands of a distribution that is not installed here cannot be compared."""
    absent = set(DISTRIBUTIONS) - set(TREE.list_commands(None))
    for words in shown_commands(page):
        if words[0] in absent:
            continue
        group, here = TREE, list(words)
        options = {opt for parameter in group.params for opt in parameter.opts}
        while here and here[0].startswith("-"):
            option = here.pop(0)
            assert option in options, words
            if option not in ("--version", "--help"):
                here.pop(0)
        while here and hasattr(group, "commands"):
            word = here.pop(0)
            group = group.get_command(None, word)
            assert group is not None, words
        known = {opt for parameter in group.params for opt in parameter.opts}
        here = here[: here.index("--")] if "--" in here else here  # behind it: another program's
        assert {word for word in here if word.startswith("-")} <= known, words


def test_every_page_with_commands_is_run_or_says_why_not():
    """The lists in `tests/pages.py` contain every page."""
    run = {*pages.RUN, pages.RUN_IN_LAB}
    assert run.isdisjoint(pages.NOT_RUN)
    assert all(pages.NOT_RUN.values())
    assert pages.pages_with("console") == {*run, *pages.NOT_RUN}


@pytest.mark.parametrize("page", [*pages.RUN, pages.RUN_IN_LAB])
def test_every_block_that_is_not_run_says_why(page):
    """At least one block of each page that is run must be run."""
    typed = [block for block in pages.blocks(page) if block.language == "console"]
    assert all(block.about for block in typed if block.mark)
    assert any(block.mark != "not run" for block in typed)
    marked = re.findall(r"<!-- (?:not run|sample|until)", (ROOT / page).read_text("utf-8"))
    assert len(marked) == sum(bool(block.mark) for block in typed)


SHOWN = """
NAME        STATE     HOST    SINCE    CPU   MEMORY   WHY
────────────────────────────────
sleeper_0   running   desk    3.1 s   0.00   1.7 MB
"""


@pytest.mark.parametrize(
    ("given", "same"),
    [
        (SHOWN.replace("3.1 s", "12 s").replace("1.7 MB", "900 kB").replace("──", "───"), True),
        (SHOWN.replace("running", "assigned"), False),
        (SHOWN.replace("sleeper_0", "sleeper_1"), False),
        (SHOWN + "one more line", False),
    ],
)
def test_an_answer_is_compared_but_for_what_differs_each_time(given, same):
    assert pages.matches(SHOWN, given) is same
    assert pages.matches("NAME ... desk ...", given)


# --- names ------------------------------------------------------------------------------------

TOPICS = {
    "resource_info", "process_status", "process_usage", "snapshot_reports", "master_beat",
    "master_load", "state_config", names.DIAGNOSTICS,
}  # fmt: skip
NAMES = {value for name, value in vars(names).items() if name.isupper() and isinstance(value, str)}
OF_A_HOST = {names.CONTROL, names.READ_LOG, names.STORE_REPLICA, names.READ_SNAPSHOT}


def test_the_protocol_page_has_every_name():
    text = (DOCS / "reference" / "protocol.md").read_text(encoding="utf-8")
    assert all(re.search(rf"`(host/HOST/)?{name}`", text) for name in NAMES)
    assert names.token("robot-1") in text


def test_the_protocol_page_says_how_a_host_gets_its_name():
    """The steps in the page turn its example into the shown name, which is rosrm's name."""
    text = (DOCS / "reference" / "protocol.md").read_text(encoding="utf-8")
    example = re.search(r"`(robot-1)` becomes `(\w+)`", text)
    assert "`_` and the first 32 hex digits of the SHA-256 of the name in UTF-8" in text
    digest = hashlib.sha256(example[1].encode()).hexdigest()[:32]
    by_the_page = f"{example[1].replace('-', '_')}_{digest}"
    assert example[2] == by_the_page == names.token(example[1])


@pytest.fixture
def policy() -> ET.Element:
    return ET.parse(DOCS / "how-to" / "rosrm.policy.xml").getroot()


def test_the_security_policy_has_every_name_and_no_other(policy):
    topics = {one.text for one in policy.iter("topic")} - {"/parameter_events"}
    services = {one.text for one in policy.iter("service")}
    assert topics == TOPICS | {"handoff/*"}  # each handoff has its own channel
    assert {re.sub(r"^host/[^/]+/", "", service) for service in services} == NAMES - TOPICS
    for service in services:
        assert service.startswith("host/") == (service.rsplit("/", 1)[-1] in OF_A_HOST)


@pytest.mark.parametrize("kind", ["reply", "request"])
def test_what_one_part_serves_another_may_call(policy, kind):
    found = {
        re.sub(r"^host/[^/]+/", "", one.text)
        for services in policy.iter("services")
        if services.get(kind) == "ALLOW"
        for one in services.iter("service")
    }
    assert found == NAMES - TOPICS
