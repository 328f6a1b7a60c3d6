"""Assertion rewriting for the contracts, so that their failures show the compared values."""

import pytest

pytest.register_assert_rewrite("rosrm.testing")
