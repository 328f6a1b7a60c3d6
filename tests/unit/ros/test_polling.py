"""Message types by name: any node may choose one, so only packages of messages are imported."""

from __future__ import annotations

import sys

import pytest
from std_msgs.msg import Int64

from rosrm.ros.polling import message_type
from rosrm_msgs.msg import HandoffReport


def test_types_of_installed_packages_are_found():
    assert message_type("std_msgs/msg/Int64") is Int64
    assert message_type("rosrm_msgs/msg/HandoffReport") is HandoffReport


@pytest.mark.parametrize(
    "name",
    [
        "foreign/msg/Thing", "foreign.deep/msg/Thing", "json/msg/tool", "os/msg/Path", "", "/msg/",
        "std_msgs/msg/", "std_msgs/msg/int64", "std_msgs/msg/Nothing", "std_msgs/msg/_int64",
        "std_msgs/srv/Int64", "std_msgs/msg/Int64.__class__", "../msg/Thing", "\0/msg/Thing",
        "no_such_package/msg/Thing", "x" * 10_000 + "/msg/Thing",
    ],
)  # fmt: skip
def test_no_other_module_is_imported(tmp_path, monkeypatch, name):
    """Importing a module runs its code."""
    package = tmp_path / "foreign" / "deep"
    package.mkdir(parents=True)
    for folder in (package.parent, package):
        (folder / "__init__.py").write_text("raise SystemExit('was run')")
        (folder / "msg.py").write_text("raise SystemExit('was run')")
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    with pytest.raises(ValueError, match=r"there is no package of messages|has no message"):
        message_type(name)
    assert {one for one in set(sys.modules) - before if not one.startswith("std_msgs")} == set()
