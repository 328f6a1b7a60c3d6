"""Commands that need no parser."""

import subprocess
import sys

import pytest

from rosrm.cli import parserless

RUN = """
import sys
from rosrm.cli import connection, early, parserless
from rosrm.errors import NoMaster
from tests.unit.cli.conftest import FakeClient

class Client(FakeClient):
    def close(self):
        print(*sorted({{"pydantic"}} & set(sys.modules)), file=sys.stderr)

def connect(*_):
    if {silent}:
        raise NoMaster("no master answered")
    return Client()

connection.connect = connect
early.join = lambda *_: None
if {parsed}:
    parserless.COMMANDS = ()
from rosrm.cli.app import main
main({words})
"""


def run(*words, silent=False, parsed=False):
    code = RUN.format(words=words, silent=silent, parsed=parsed)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    return done.returncode, done.stdout, done.stderr.splitlines()


@pytest.mark.parametrize("options", [(), ("--json",)])
@pytest.mark.parametrize("name", parserless.COMMANDS)
def test_a_command_prints_without_the_parser_the_same_as_with_it(name, options):
    """The output is equal, and pydantic is not imported."""
    code, out, imported = run(name, *options)
    assert (code, bool(out), imported) == (0, True, [""])
    assert run(name, *options, parsed=True)[:2] == (0, out)


def test_an_error_has_the_same_message_and_exit_code_without_the_parser():
    assert run("ps", silent=True)[::2] == (3, ["rosrm: no master answered"])


@pytest.mark.parametrize("words", [(), ("ps", "-a"), ("ps", "--json", "--json"), ("submit",)])
def test_any_other_line_is_left_to_the_parser(words):
    assert parserless.command(words) is None


def test_a_participant_is_created_before_messages_and_numpy_are_imported():
    """Discovery runs while they are imported, which takes as long."""
    code = (
        "import sys, rosrm.cli.early, rosrm.ros.participant\n"
        "print(*{'numpy', 'rosrm_msgs'} & set(sys.modules))"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "\n"
