"""docs/reference/keys.md: roles, the key file and the program that it shows."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rosrm.keys import key_files
from rosrm.keys.roles import ALLOWED, Role

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "reference" / "keys.md").read_text(encoding="utf-8")


def rows(header: str) -> list[list[str]]:
    """Return the cells of the table with a header."""
    table = PAGE.partition(f"| {header} |")[2].partition("\n\n")[0]
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]
    ]


def words(cell: str) -> list[str]:
    return re.findall(r"`(\w+)`", cell)


def test_the_roles_are_those_of_the_code():
    """Names, meanings and order."""
    assert rows("role | may") == [[f"`{role.value}`", role.meaning] for role in Role]


def test_the_requests_of_each_role_are_those_of_the_code():
    """Each request of the code is in one row, with its roles."""
    shown = {
        request: frozenset(map(Role, words(roles)))
        for requests, roles in rows("request | roles") for request in words(requests)
    }  # fmt: skip
    assert shown == {request: one.roles for request, one in ALLOWED.items()}
    assert sum(len(words(requests)) for requests, _ in rows("request | roles")) == len(ALLOWED)


def test_the_key_file_is_that_of_the_test_vectors(tmp_path):
    """The page shows the key of the principal in the vectors."""
    vector = json.loads((ROOT / "tests/data/keys/vectors.json").read_text(encoding="utf-8"))
    path = tmp_path / "robot-1.key"
    path.touch(mode=0o600)
    path.write_text(re.search(r"```text\n(principal: .*?)```", PAGE, re.DOTALL)[1])
    key = key_files.read_key(path)
    assert (str(key.grant.principal), key.grant.generation) == ("host:robot-1", 3)
    assert (key.key.hex(), key.master.hex()) == (
        vector["principal_key"], vector["master_public_key"]
    )  # fmt: skip


def test_the_program_of_the_page_computes_the_test_vectors(monkeypatch: pytest.MonkeyPatch):
    """The program has its own assertions, and needs no library but the standard one."""
    program = re.search(r"<!-- vectors -->\n```python\n(.*?)```", PAGE, re.DOTALL)[1]
    assert set(re.findall(r"^import (\w+)$", program, re.MULTILINE)) == {
        "hashlib", "json", "struct"
    }  # fmt: skip
    monkeypatch.chdir(ROOT)
    exec(program, {})
