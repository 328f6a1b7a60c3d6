"""Commands of other distributions by the entry-point group `rosrm.commands`."""

from __future__ import annotations

import signal

import pytest

from rosrm.cli import command_tree

#: Module with a function, a group, and objects that are no commands.
MODULE = '''
import typer

def hello(name: str, loudly: bool = False) -> None:
    """Greet someone."""
    print(f"hello {name}" + ("!" if loudly else ""))

def strange(value: int | str) -> None:
    """Has an argument that no command line can have."""

tools = typer.Typer(no_args_is_help=True, help="Tools of acme.")

@tools.callback()
def _group() -> None: ...

@tools.command()
def saw(times: int) -> None:
    """Saw some wood."""
    print("saw " * times)

def spoil() -> None:
    """Fail."""
    raise KeyError("salt")

def settle(stop: bool = False) -> None:
    """Defer Ctrl-C, and ignore it from now on."""
    import signal
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if stop:
        raise KeyboardInterrupt

number = 7
'''


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install distributions, as far as Python sees it: metadata and one module on the path."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "acme_commands.py").write_text(MODULE)

    def install(distribution, *entry_points):
        metadata = tmp_path / f"{distribution}-1.5.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.5\n"
        )
        lines = "\n".join(("[rosrm.commands]", *entry_points))
        (metadata / "entry_points.txt").write_text(lines)

    return install


def test_a_function_is_a_command(rosrm, installed):
    """An entry point that names a function adds a command with its arguments and help."""
    installed("acme", "hello = acme_commands:hello")

    assert rosrm("hello", "you", "--loudly").out == "hello you!\n"
    assert "hello" in rosrm("--help").out.partition("Commands:")[2]
    assert "Greet someone." in rosrm("hello", "-h").out
    assert rosrm("hello").code == 2


def test_a_typer_app_is_a_group_of_commands(rosrm, installed):
    """An entry point that names a `typer.Typer` adds a group, with plain usage lines."""
    installed("acme", "tools = acme_commands:tools")

    assert rosrm("tools", "saw", "2").out == "saw saw \n"
    assert "Tools of acme." in rosrm("--help").out
    assert "\n  saw " in rosrm("tools", "--help").out


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("no_such_module:hello", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("acme_commands:nothing", "AttributeError: "),
        ("acme_commands:number", "TypeError: 7 is neither a function nor a typer.Typer"),
        ("acme_commands:strange", "AssertionError: Typer currently"),
    ],
)
def test_a_command_that_cannot_be_loaded_is_one_sentence(rosrm, installed, target, said):
    """The sentence names the distribution and the error; the help lists it, and works."""
    installed("acme", f"hello = {target}")

    result = rosrm("hello", "you", "--help")

    assert (result.code, result.out, result.err.count("\n")) == (1, "", 1)
    assert f"rosrm: the command 'hello' of acme 1.5 cannot be loaded: {said}" in result.err
    assert "the command 'hello' of acme 1.5 cannot be loaded" in rosrm("--help").out


def test_a_command_of_rosrm_cannot_be_replaced(rosrm, installed):
    """A distribution cannot take the name of a built-in command."""
    installed("acme", "config = acme_commands:hello")

    assert rosrm("config", "check", "--help").code == 0
    assert rosrm("--help").out.count("\n  config ") == 1


def test_a_command_with_the_name_of_one_of_rosrm_is_listed_as_broken(rosrm, installed):
    """The listing of local plugins says why the command is ignored."""
    installed("acme", "ps = acme_commands:hello")

    rows = [line for line in rosrm("plugins", "--local").out.splitlines() if "acme" in line]
    assert len(rows) == 1
    assert "its command is ignored, because rosrm has one of this name" in rows[0]


@pytest.mark.parametrize(("options", "code"), [((), 0), (("--stop",), 130)])
def test_a_command_decides_when_ctrl_c_ends_it(rosrm, installed, options, code):
    """Ctrl-C that it deferred is no fault; what it ignores cannot end the process any more."""
    installed("acme", "settle = acme_commands:settle")
    before = signal.getsignal(signal.SIGINT)
    try:
        result = rosrm("settle", *options)
        assert (result.code, result.err) == (code, "")
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("traceback", [False, True])
def test_an_exception_of_a_command_is_one_sentence_with_its_place(
    rosrm, installed, monkeypatch, traceback
):
    """The sentence names distribution, error, file and line; a variable shows the traceback."""
    installed("acme", "spoil = acme_commands:spoil")
    monkeypatch.setenv("ROSRM_TRACEBACK", "1" if traceback else "")

    result = rosrm("spoil")

    assert result.code == 1
    assert "rosrm: the command 'spoil' of acme 1.5 failed: KeyError: 'salt' (" in result.err
    assert "acme_commands.py:" in result.err
    assert ("Traceback" in result.err) == traceback


def test_two_distributions_with_one_command_are_both_named(rosrm, installed):
    """A command that two distributions bring is neither's: the user uninstalls one of them."""
    for distribution in ("acme", "bolt"):
        installed(distribution, "hello = acme_commands:hello")

    result = rosrm("hello", "you")

    said = "rosrm: the command 'hello' is in acme 1.5 and bolt 1.5; uninstall all but one\n"
    assert (result.code, result.err) == (1, said)


def test_a_misspelt_command_of_another_distribution_is_hinted_at(rosrm, installed):
    """Hints name installed commands as they name built-in ones."""
    installed("acme", "hello = acme_commands:hello")

    result = rosrm("hallo")

    assert result.code == 2
    assert "No such command 'hallo'. Did you mean 'hello'?" in result.err


@pytest.mark.parametrize(
    ("command", "distribution"),
    [
        ("alerts", "rosrm-alerts"),
        ("lab", "rosrm-lab"),
        ("launch", "rosrm-launch"),
        ("metrics", "rosrm-web"),
        ("report", "rosrm-report"),
        ("simulate", "rosrm-simulate"),
        ("web", "rosrm-web"),
    ],
)
def test_a_command_whose_distribution_is_absent_names_it(rosrm, monkeypatch, command, distribution):
    """A command of this repository that is not installed says in one sentence where it is."""
    monkeypatch.setattr(command_tree, "find_commands", dict)

    result = rosrm(command, "up", "--help")

    said = f"rosrm: the command {command!r} comes with `pip install {distribution}`\n"
    assert (result.code, result.out, result.err) == (2, "", said)


def test_a_command_of_rosrm_is_found_without_a_search(rosrm, monkeypatch):
    """The search reads the metadata of all distributions: only other commands wait for that."""

    def search():
        raise AssertionError("no search is needed")

    monkeypatch.setattr(command_tree, "find_commands", search)

    assert rosrm("ps", "--help").code == 0
