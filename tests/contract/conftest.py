"""The contracts report what was compared, as tests in a test file do."""

import pytest

pytest.register_assert_rewrite("rosrm.testing")
