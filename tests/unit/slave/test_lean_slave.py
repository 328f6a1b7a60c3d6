"""Modules of a slave; see docs/decisions/0006."""

import subprocess
import sys

from rosrm.extensions.installed import installed_plugins

#: Modules that a slave without processes does not need, largest first.
NOT_NEEDED = (
    "numpy", "pydantic", "rich", "typer", "lark", "psutil", "asyncio", "multiprocessing", "sqlite3",
    "urllib.request", "http.client", "email", "ssl", "statistics", "decimal", "argparse",
    "hashlib", "annotated_types", "typing_extensions", "rosrm_msgs.srv._submit", "platform",
    "rosrm.model.notices",
    "rosrm.master", "rosrm.ros.master", "rosrm.core.master.events",
)  # fmt: skip
CODE = f"""
import sys
from pathlib import Path
import rosrm.slave.__main__
from rosrm.extensions.contracts import LauncherContext, ProbeContext
from rosrm.extensions.installed import PluginAddress
from rosrm.extensions.registry import SLAVE_KINDS, Registry

registry = Registry.load({installed_plugins()}, SLAVE_KINDS)
registry.probes(None, ProbeContext("machine", {{}}, Path("/"), None))
registry.launchers(LauncherContext(Path("/nowhere"), sys.executable, 1))
print(*[name for name in {NOT_NEEDED} if name in sys.modules])
"""


def test_a_slave_imports_no_module_that_it_does_not_need(tmp_path):
    """Neither the slave nor a plugin that it loads imports the listed modules."""
    done = subprocess.run(
        [sys.executable, "-c", CODE], env={"PATH": str(tmp_path)}, capture_output=True, text=True,
        timeout=60, check=True,
    )  # fmt: skip
    assert done.stdout.split() == []
