"""The page on virtual hosts, followed with root rights: commands and files as printed."""

from __future__ import annotations

from contextlib import closing

import pytest

from tests.pages import RUN_IN_LAB, Page, Reader, blocks


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_command_of_the_page_does_what_it_shows(name, tmp_path):
    work = {one.title: one.text for one in blocks("README.md") if one.title == "work.yaml"}
    with closing(Reader(tmp_path, 42)) as reader:
        reader.environment["ROSRM_LAB"] = name
        reader.called[name] = "lab"
        reader.follow(RUN_IN_LAB, Page(files=work))
