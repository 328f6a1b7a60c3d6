"""The plugin tutorials, followed as written: files created, commands run, outputs compared."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).resolve().parents[3] / "docs/tutorials"
SCORING = TUTORIALS / "your-own-scoring-plugin.md"
MIGRATION = TUTORIALS / "your-own-migration-strategy.md"
#: Tutorials that begin with `rosrm plugin new`, and the number of their commands.
FROM_TEMPLATE = {
    TUTORIALS / "your-own-filter.md": 4,
    TUTORIALS / "your-own-probe.md": 6,
    TUTORIALS / "your-own-checkpoint-policy.md": 4,
}

_BLOCK = re.compile(
    r"<!-- (?P<what>file|run)(: (?P<about>[^>]*?))? -->\n```\w+\n(?P<text>.*?)```", re.DOTALL
)


@dataclass(frozen=True)
class Command:
    """A command that a reader types, with the output and the exit code that the page shows."""

    line: str
    answer: str
    code: int


def blocks(page: Path) -> Iterator[tuple[str, str] | Command]:
    """Yield the files (name and text) and the commands of a tutorial, in order."""
    for block in _BLOCK.finditer(page.read_text(encoding="utf-8")):
        about, text = block["about"] or "", block["text"]
        if block["what"] == "file":
            yield about, text
            continue
        code = int(about.removeprefix("exit ") or 0)
        for shown in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
            line, _, answer = shown.partition("\n")
            yield Command(line, answer.strip(), code)


def matches(shown: str, given: str) -> bool:
    """Return True if the output fits: `...` is a wildcard, and runs of spaces are equal."""
    parts = [re.escape(part.strip()) for part in shown.split("...")]
    pattern = ".*".join(part.replace(r"\ ", r"\s+").replace("\\\n", r"\s+") for part in parts)
    return re.fullmatch(pattern, given.strip(), re.DOTALL) is not None


def do(page: Path, environment) -> list[str]:
    """Create the files of a tutorial and run its commands; return these."""
    folder, done = environment.folder, []
    for block in blocks(page):
        if isinstance(block, Command):
            if block.line.startswith("cd "):
                folder /= block.line.removeprefix("cd ")
                continue
            result = environment.shell(block.line, folder)
            said = result.stdout + result.stderr
            assert result.returncode == block.code, f"$ {block.line}\n{said}"
            assert matches(block.answer, said), f"$ {block.line}\n{said}"
            done.append(block.line)
        else:
            name, text = block
            (folder / name).write_text(text, encoding="utf-8")
    return done


def test_the_tutorial_of_a_strategy_does_what_it_says(environment):
    """An empty folder becomes a strategy that keeps the contract and is selected by name."""
    done = do(MIGRATION, environment)
    assert "python -m pytest -q test_roomy.py" in done
    assert "rosrm config check cluster.yaml work.yaml" in done
    assert len(done) == 4


@pytest.mark.parametrize("page", FROM_TEMPLATE, ids=lambda page: page.stem)
def test_a_tutorial_from_a_template_does_what_it_says(page, environment):
    """The written package becomes another plugin that keeps the contract and is selected."""
    done = do(page, environment)
    assert "pip install --quiet ." in done
    assert len(done) == FROM_TEMPLATE[page]


def test_the_tutorial_does_what_it_says(environment):
    """An empty folder becomes a policy that is pip-installed and selected by name."""
    done = do(SCORING, environment)
    assert "pip install --quiet ." in done
    assert "rosrm config check cluster.yaml" in done
    assert len(done) == 6

    code = (
        "from rosrm.extensions.registry import Registry\n"
        "from rosrm.config.cluster import load_cluster\n"
        "from rosrm.config.settings import ClusterConfig\n"
        "registry = Registry.discover()\n"
        "config = load_cluster('rosrm-fewest/cluster.yaml', registry)\n"
        "config = ClusterConfig.from_json(config.to_json())\n"
        "policy = registry.scoring(config.scoring[0].policy, config.scoring[0].options)\n"
        "print(type(policy).__module__, policy._most)\n"
    )
    assert environment.python(code).split() == ["rosrm_fewest", "20"]


@pytest.mark.parametrize(
    ("page", "only_shown"),
    [
        (SCORING, 1),
        (MIGRATION, 0),
        *((page, page.stem.endswith("filter")) for page in FROM_TEMPLATE),
    ],
)
def test_every_marked_block_is_found(page, only_shown):
    """The pattern finds all marked blocks; a misspelt mark would silently skip a block."""
    text = page.read_text(encoding="utf-8")
    assert text.count("<!--") == len(list(_BLOCK.finditer(text)))
    assert text.count("```") == 2 * (text.count("<!--") + only_shown)
