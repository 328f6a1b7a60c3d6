"""`Registry.discover`: entry points of installed distributions, each isolated from the others."""

from __future__ import annotations

import logging
import sys

import pytest

from rosrm.errors import ConfigError
from rosrm.extensions.registry import Registry

GOOD = """
from rosrm.extensions.hookspecs import hookimpl
from rosrm.extensions.contracts import ScoringOffer

@hookimpl
def register_scoring_policies():
    return [ScoringOffer("{name}", lambda options: Made(), summary="one line")]

class Made:
    score = "made"
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a distribution with one plugin module where Python finds it, as pip would."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def put(module: str, code: str, distribution: str = "", version: str = "1.0"):
        (tmp_path / f"{module}.py").write_text(code, encoding="utf-8")
        distribution = distribution or module.replace("_", "-")
        folder = tmp_path / f"{distribution.replace('-', '_')}-{version}.dist-info"
        folder.mkdir(exist_ok=True)
        metadata = f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        (folder / "METADATA").write_text(metadata, encoding="utf-8")
        (folder / "entry_points.txt").write_text(f"[rosrm]\n{module} = {module}\n")
        monkeypatch.delitem(sys.modules, module, raising=False)

    return put


def rows_of(registry, *names):
    return [row for row in registry.rows() if row.name in names]


def test_an_installed_plugin_is_found_with_its_distribution(install):
    install("vx_good", GOOD.format(name="vx"))
    registry = Registry.discover()
    (row,) = rows_of(registry, "vx")
    assert (row.kind, row.distribution, row.state) == ("scoring", "vx-good 1.0", "available")
    assert row.reason == "one line"
    assert registry.scoring("vx").score == "made"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import no_such_module_at_all", "does not import: ModuleNotFoundError: No module named"),
        ("raise RuntimeError('boom')", "does not import: RuntimeError: boom"),
        ("def broken(:", "does not import: SyntaxError"),
        ("import sys; sys.exit(3)", "does not import: SystemExit: 3"),
    ],
)
def test_a_plugin_that_does_not_import_is_broken_and_the_others_go_on(install, code, said):
    install("vx_good", GOOD.format(name="vx"))
    install("vx_bad", code)
    registry = Registry.discover()
    bad, good = rows_of(registry, "vx_bad", "vx")[::-1]
    assert (good.name, good.state) == ("vx", "available")
    assert (bad.state, bad.distribution) == ("broken", "vx-bad 1.0")
    assert said in bad.reason
    with pytest.raises(ConfigError, match=r"Broken: .*plugin 'vx_bad' of vx-bad 1.0: does not imp"):
        registry.scoring("bad")


def test_two_distributions_with_one_name_are_both_named(install):
    install("vx_one", GOOD.format(name="vx"))
    install("vx_two", GOOD.format(name="vx"))
    with pytest.raises(ConfigError) as refused:
        Registry.discover().scoring("vx")
    said = str(refused.value)
    assert "by plugin 'vx_one' of vx-one 1.0 and plugin 'vx_two' of vx-two 1.0: uninstall" in said


def test_a_plugin_that_takes_long_to_import_is_named_in_the_log(install, caplog, monkeypatch):
    monkeypatch.setattr("rosrm.extensions.discovery.SLOW_LOADING", 0.1)
    install("vx_slow", "import time; time.sleep(1.0)")
    with caplog.at_level(logging.WARNING, "rosrm.plugins"):
        Registry.discover()
    said = (
        "plugin 'vx_slow' of vx-slow 1.0 is still being loaded after 0.1 s: the import of vx_slow"
    )
    assert said in caplog.text


def test_ctrl_c_during_an_import_is_not_taken_for_a_fault(install):
    """The user's Ctrl-C ends a command, also while it imports a plugin."""
    install(
        "vx_stop", "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(9)"
    )
    with pytest.raises(KeyboardInterrupt):
        Registry.discover()


def test_a_plugin_that_raises_the_exception_of_ctrl_c_is_broken(install):
    """Such a plugin ends no command and no part, as one that raises any other exception."""
    install("vx_stop", "raise KeyboardInterrupt")
    (broken,) = Registry.discover().broken
    assert broken.reason.startswith("does not import: KeyboardInterrupt (")


def test_what_a_plugin_prints_at_its_import_is_no_output_of_a_command(install, capsys):
    """The text goes to standard error, so that the output with --json is JSON alone."""
    install("vx_loud", "print('loaded')\n" + GOOD.format(name="loud"))
    Registry.discover()
    output = capsys.readouterr()
    assert (output.out, "loaded\n" in output.err) == ("", True)
