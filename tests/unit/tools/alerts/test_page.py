"""The file and the output on the page about alerts."""

import re
from pathlib import Path

from typer.testing import CliRunner

from rosrm.cli.command_tree import app

PAGE = Path(__file__).resolve().parents[4] / "docs/how-to/alerts.md"


def test_the_file_that_is_shown_passes_its_own_tests(tmp_path, monkeypatch):
    """`rosrm alerts check` prints what the page shows."""
    text = PAGE.read_text(encoding="utf-8")
    (tmp_path / "alerts.yaml").write_text(re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)[0])
    monkeypatch.chdir(tmp_path)

    done = CliRunner().invoke(app, ["alerts", "check", "alerts.yaml"])

    assert done.output, done.exception
    assert done.output in text
