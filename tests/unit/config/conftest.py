"""Fixtures: a configuration file with a text, and the error of a loader that refuses it."""

from __future__ import annotations

from textwrap import dedent

import pytest

from rosrm.errors import ConfigError


@pytest.fixture
def file(tmp_path):
    """Write a text to `f.yaml` in a folder of the test's own."""

    def write(text: str):
        path = tmp_path / "f.yaml"
        path.write_text(dedent(text), encoding="utf-8")
        return path

    return write


@pytest.fixture
def refusal(file):
    """Return a loader's error message for a text, without the folder's name."""

    def load(loader, text: str, *more) -> str:
        path = file(text)
        with pytest.raises(ConfigError) as refused:
            loader(path, *more)
        return str(refused.value).replace(f"{path.parent}/", "")

    return load
