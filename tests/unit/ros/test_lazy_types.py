"""Types of `rosrm_msgs` are imported one by one."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import rosrm.ros  # noqa: F401 - it changes the imports below
from rosrm_msgs import msg, srv


@pytest.mark.parametrize("package", [msg, srv])
def test_a_package_has_every_type_that_the_generated_one_imports(package) -> None:
    generated = Path(package.__path__[0], "__init__.py").read_text()
    names = re.findall(r"import (\w+)", generated)
    assert names
    assert [getattr(package, name).__name__ for name in names] == names


def test_an_unknown_type_is_a_missing_attribute_and_a_failed_import() -> None:
    assert not hasattr(msg, "Nothing")
    with pytest.raises(ImportError, match="Nothing"):
        from rosrm_msgs.srv import Nothing  # noqa: F401


def test_the_import_of_one_type_imports_no_other() -> None:
    program = """if True:
        import sys, rosrm.ros
        from rosrm_msgs.srv import RegisterHost
        print(*(name for name in sys.modules if name.startswith("rosrm_msgs.")))
    """
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert found.stdout.split() == ["rosrm_msgs.srv", "rosrm_msgs.srv._register_host"]
