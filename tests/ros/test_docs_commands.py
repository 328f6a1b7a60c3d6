"""The pages of the documentation, followed on a real cluster: commands and files as printed."""

from __future__ import annotations

from contextlib import closing

import pytest

from rosrm.testing.local_cluster import claim_domain
from tests.pages import RUN, Reader
from tests.programs import require


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", RUN)
def test_every_command_of_a_page_does_what_the_page_shows(page, tmp_path, request):
    require(RUN[page].program)
    if RUN[page].criu:
        request.getfixturevalue("criu")
    domain, claim = claim_domain()
    with closing(claim), closing(Reader(tmp_path, domain)) as reader:
        reader.follow(page, RUN[page])
