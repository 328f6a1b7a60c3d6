"""Text of other hosts and users on a terminal whose encoding lacks some of its characters."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import replace

import pytest
from rich.cells import cell_len
from rich.text import Text

from rosrm.cli.output import log_lines, tables, top
from rosrm.cli.output.legible import legible, never_fail
from rosrm.cli.output.log_lines import LogStream
from rosrm.client.logs import LogChunk
from rosrm.errors import Refused
from rosrm.model.rows import Listing
from tests.unit.cli.conftest import PLUGINS, STORY, event, host, process

#: An arrow, letters of other scripts, a symbol beyond 16 bits, and a lone surrogate.
FOREIGN = "a → é 東京 😀 \ud800"
ENCODINGS = ("ascii", "iso8859-1", "cp437", "utf-8")


in_each_encoding = pytest.mark.parametrize("encoding", ENCODINGS)


class Output(io.TextIOWrapper):
    """Standard output of an encoding, which refuses what the encoding lacks."""

    def __init__(self, encoding):
        super().__init__(io.BytesIO(), encoding=encoding)

    def written(self) -> str:
        self.flush()
        return self.buffer.getvalue().decode(self.encoding)


@pytest.mark.parametrize("charset", ENCODINGS)
@pytest.mark.parametrize(
    "command", ["ps", "hosts", "plugins", "events", "status", "top -n 1", "explain talker"]
)
def test_every_listing_is_shown_in_every_encoding(rosrm, client, command, charset):
    """A character that the terminal lacks, in the reason of any job, breaks no listing."""
    client.processes = [process("talker", "failed", reason=FOREIGN), process("other")]
    client.hosts = [host("alpha")]
    client.plugins = [replace(PLUGINS[0], reason=FOREIGN, state="failing")]
    client.events = [event(1, message=FOREIGN)]
    client.trouble = FOREIGN
    client.explain = lambda _: {**STORY, "reason": FOREIGN, "reasons": [FOREIGN]}
    ran = rosrm(*command.split(), charset=charset)
    assert ran.code == 0, ran.err
    client.fails = Refused(FOREIGN)
    said = rosrm("ps", charset=charset).err
    assert "\\ud800" in said
    assert ("→" in said) == (charset == "utf-8")


@in_each_encoding
@pytest.mark.parametrize("letter", ["→", "東", "😀", "\x1b"])
def test_the_columns_of_tables_stay_aligned(encoding, letter):
    """A number is wider than its character."""
    with redirect_stdout(Output(encoding)) as stdout:
        made = tables.table("NAME", "WHY", "HOST")
        made.add_row(f"a{letter}b", Text(f"x {letter}"), "here")
        made.add_row("a", "x", "here")
        tables.show(made)
    lines = [line for line in stdout.written().splitlines() if "here" in line]
    assert len({cell_len(line) for line in lines}) == 1


@in_each_encoding
def test_the_colours_of_a_cell_stay_at_their_words(encoding):
    """The colour of a state stays at the state, also after a name with a long number."""
    with redirect_stdout(Output(encoding)):
        made = tables.table("NAME")
        made.add_row(Text("→ ").append("failed", "red"))
    (cell,) = made.columns[0].cells
    assert [cell.plain[span.start : span.end] for span in cell.spans] == ["failed"]


@in_each_encoding
def test_the_live_view_draws_with_the_characters_of_the_terminal(encoding):
    """Bars and cut reasons keep their width."""
    listing = Listing("lab", 1.0, 1, [host("alpha")], [process("p", "queued", reason="w " * 90)])
    with redirect_stdout(Output(encoding)) as stdout:
        tables.PrintableConsole(width=80).print(top.TopView(listing))
    assert "\\u" not in stdout.written()
    assert max(map(len, stdout.written().splitlines())) <= 80


@in_each_encoding
def test_output_of_a_process_in_a_terminal_has_the_encoding_of_the_terminal(encoding):
    stream = LogStream("p", raw=False)
    with redirect_stdout(Output(encoding)) as stdout:
        stream.write(LogChunk("p", "alpha", 1, "5 → é\n".encode(), 0, 0, True, []))
        log_lines.show(stream.take())
        assert stdout.written() == f"{legible('5 → é')}\n"


@in_each_encoding
def test_what_nobody_checked_is_written_too(encoding):
    """The streams accept help texts, and texts that libraries print to them."""
    with redirect_stdout(Output(encoding)) as stdout:
        never_fail()
        print(FOREIGN)
        assert stdout.written() == f"{legible(FOREIGN)}\n"
