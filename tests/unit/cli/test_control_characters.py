"""Text from other hosts and users on the terminal: control characters are shown, not executed."""

from __future__ import annotations

import ast
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

import rosrm.cli
from rosrm.cli.output import log_lines, tables, top
from rosrm.cli.output.log_lines import LogStream
from rosrm.client.logs import LogChunk
from rosrm.errors import Refused
from rosrm.model.rows import Listing
from tests.unit.cli.conftest import PLUGINS, event, host, process

#: Renames the window, hides text, and moves up a line: as ESC sequences, and as C1 characters.
EVIL = "a\x1b]0;owned\x07b\x9b8mc\rd\x7fe\x08f"
SHOWN = r"a\x1b]0;owned\x07b\x9b8mc\x0dd\x7fe\x08f"
CONTROLS = {*map(chr, range(32)), "\x7f", *map(chr, range(0x80, 0xA0))} - {"\n", "\t"}


def controls_in(text: str) -> set[str]:
    return CONTROLS & set(text)


@pytest.fixture
def evil(client):
    """A cluster in which every name, reason and message has control characters."""
    client.hosts = [replace(host(EVIL, EVIL), description=host(EVIL).description)]
    client.processes = [process(EVIL, "failed", EVIL, reason=EVIL)]
    client.plugins = [replace(PLUGINS[0], name=EVIL, reason=EVIL, state=EVIL)]
    client.events = [event(1, EVIL, EVIL, EVIL, EVIL)]
    client.trouble = EVIL
    return client


@pytest.mark.parametrize("command", ["ps", "hosts", "plugins", "events", "status", "top -n 1"])
def test_a_listing_shows_control_characters_as_numbers(rosrm, evil, command):
    ran = rosrm(*command.split())
    output = ran.out + ran.err
    assert r"a\x1b]0;owned" in output
    assert not controls_in(output)


@pytest.mark.parametrize("command", ["ps", "events"])
def test_json_escapes_control_characters_itself(rosrm, evil, command):
    """A program reads the names as they are."""
    output = rosrm(command, "--json").out
    assert not controls_in(output)
    assert EVIL in json.loads(output)[0].values()


def test_an_error_of_the_master_is_printed_without_control_characters(rosrm, client):
    client.fails = Refused(EVIL)
    said = rosrm("ps").err
    assert SHOWN in said
    assert not controls_in(said)


def test_a_terminal_keeps_the_colours_of_rosrm_itself():
    """Only texts are changed: the styles of tables are sequences of the terminal."""
    shown = io.StringIO()
    console = tables.PrintableConsole(file=shown, force_terminal=True, width=200)
    listing = Listing("lab", 1.0, 1, [host("a")], [process(EVIL, "running")])
    console.print(top.TopView(listing))
    console.print(tables.processes(listing.processes))
    text = shown.getvalue()
    assert "\x1b[32mrunning" in text
    assert r"a\x1b]0;owned" in text
    assert "\x1b]0" not in text
    assert "\x9b" not in text


def test_an_event_in_a_pipe_cannot_look_like_two():
    """Further lines are indented as deep as the message."""
    line = tables.event_line(event(1, message="one\n12:00:00  finished           job ended"))
    first, second = line.splitlines()
    assert second.startswith(" " * first.index("one"))


def chunk(content: bytes, offset: int = 0) -> LogChunk:
    return LogChunk("p", "alpha", 1, content, offset, 0, offset == 0, [])


def text_of(stream: LogStream, *parts: bytes) -> bytes:
    offset = 0
    for part in parts:
        stream.write(chunk(part, offset))
        offset += len(part)
    stream.close()
    return b"".join(text for _, text in stream.take())


@pytest.mark.parametrize("prefix", [b"", b"a | "])
def test_output_of_a_process_is_readable_in_a_terminal(prefix):
    """Divided characters stay whole; invalid bytes are shown; a newline of Windows is one."""
    parts = [b"\xe2\x82", b"\xac \x1b[31mred\r\nraw \x9b \xc2\x9b", b" tab\t.\n"]
    expected = "€ \\x1b[31mred\nraw \\x9b \\x9b tab\t.\n".encode()
    shown = text_of(LogStream("p", prefix, raw=False), *parts)
    assert shown == b"".join(prefix + line + b"\n" for line in expected.splitlines())


def test_raw_output_of_a_process_is_copied_byte_by_byte():
    parts = [b"\xe2\x82", b"\xac \x1b[31mred\r\n\x9b\xff"]
    assert text_of(LogStream("p", raw=True), *parts) == b"".join(parts)


@pytest.mark.parametrize(
    ("is_terminal", "options", "raw"),
    [(True, [], False), (True, ["--raw"], True), (False, [], True), (False, ["--raw"], True)],
)
def test_only_a_terminal_gets_output_without_control_characters(
    rosrm, client, monkeypatch, is_terminal, options, raw
):
    """A file or pipe gets the bytes of the process: programs read them."""
    given = []
    monkeypatch.setattr(log_lines, "is_terminal", lambda: is_terminal)
    monkeypatch.setattr(
        "rosrm.cli.log_copies.copy_logs", lambda _, streams, *__: given.extend(streams)
    )
    rosrm("logs", "talker", *options)
    assert [stream.raw for stream in given] == [raw]


def test_every_command_prints_through_the_two_places_that_replace_control_characters():
    """A new command that called typer or rich itself would print what other users wrote."""
    root = Path(rosrm.cli.__file__).parent
    found = {
        f"{path.relative_to(root)}: {ast.unparse(node.func)}"
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) in {"typer.echo", "print", "Console", "rich.print", "echo.echo"}
    }
    assert found == {"output/plain.py: typer.echo"}
    assert issubclass(tables.PrintableConsole, Console)
