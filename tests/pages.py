"""The pages of the documentation as a reader follows them: files are saved, commands are typed.

Of a page, each fenced block that has a title is a file, and each `console` block is what is typed
at the prompts `$` and `#` (root), and answered. What the page shows as an answer is compared: `...`
stands for anything, and numbers with units, times and addresses for any others. A command that
fails, or that shows another answer than yet, is given again for a while, as by a reader who waits
for what the page promises. What stays (`rosrm master`, `slave`, `events -f`) has its own terminal.

A mark in the line above a console block says what is different about it:

    <!-- not run: REASON -->      a reader follows it elsewhere: another machine, root, a long time
    <!-- sample: REASON -->       it is run, and of its answers only the first line is compared
    <!-- until: TEXT -->          it is followed by waiting for TEXT in the terminal opened last

A page has fixed numbers for a pid and a port: 4711 is the program that was started last with `&`,
and 8290 the port of `rosrm web`.

A `pycon` block is a Python session, which doctest compares; those with the mark `<!-- cluster -->`
need a cluster.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rosrm.runtime.ros_wheels import without_bootstrapper

ROOT: Final = Path(__file__).resolve().parents[1]
#: Seconds for what a page promises, on a busy machine; for what `until` waits for.
PATIENCE: Final = 40.0
LONG_PATIENCE: Final = 120.0


@dataclass(frozen=True)
class Page:
    """The cluster and the files that the reader of a page has before.

    Attributes:
        hosts: that have slaves, beside those of the page.
        cluster: settings of their master.
        files: that lie there already.
        before: commands that the reader has typed before.
        criu: it needs CRIU.
        program: that it needs, and that a machine may lack.
    """

    hosts: tuple[str, ...] = ()
    cluster: str = "name: before"
    files: Mapping[str, str] = field(default_factory=dict)
    before: tuple[str, ...] = ()
    criu: bool = False
    program: str = "bash"


#: The pages whose commands are run, on a cluster of slices.
RUN: Final[Mapping[str, Page]] = {
    "README.md": Page(),
    "docs/tutorials/first-cluster.md": Page(),
    "docs/tutorials/your-first-application.md": Page(),
    "docs/how-to/limits-and-migration.md": Page(hosts=("robot-1", "robot-2")),
    "docs/how-to/applications.md": Page(hosts=("robot-1", "robot-2")),
    "docs/how-to/modes.md": Page(hosts=("robot-1", "robot-2")),
    "docs/how-to/stateful-node.md": Page(hosts=("desk", "shelf")),
    "docs/how-to/portable-node.md": Page(
        hosts=("robot",), cluster="migration: {strategies: [criu]}"
    ),
    "docs/how-to/simulate.md": Page(),
    "docs/how-to/keys.md": Page(),
    "docs/how-to/adopt.md": Page(hosts=("robot-1",)),
    "docs/how-to/criu.md": Page(
        hosts=("robot",),
        cluster="migration: {strategies: [criu]}",
        criu=True,
        files={"brain.yaml": "processes: [{name: brain, command: sleep 1000}]\n"},
        before=("rosrm submit brain.yaml",),
    ),
    "docs/how-to/web.md": Page(
        hosts=("robot-1", "robot-2"),
        files={"talker.yaml": "processes: [{name: talker, command: sleep 1000}]\n"},
        before=("rosrm submit talker.yaml",),
        program="curl",
    ),
}
#: The pages that are run on virtual hosts, where root is.
RUN_IN_LAB: Final = "docs/how-to/lab.md"
#: The page whose examples are Python; those marked `cluster` need one.
PYTHON: Final = "docs/reference/python.md"
#: The pages whose commands no test here runs, and why.
NOT_RUN: Final[Mapping[str, str]] = {
    "docs/tutorials/your-own-scoring-plugin.md": "tests/integration/plugins/test_tutorial.py does",
    "docs/tutorials/your-own-migration-strategy.md": "tests/integration/plugins/test_tutorial.py",
    "docs/tutorials/your-own-filter.md": "tests/integration/plugins/test_tutorial.py",
    "docs/tutorials/your-own-probe.md": "tests/integration/plugins/test_tutorial.py",
    "docs/tutorials/your-own-checkpoint-policy.md": "tests/integration/plugins/test_tutorial.py",
    "docs/how-to/two-machines.md": "two machines",
    "docs/how-to/wireguard.md": "a kernel with WireGuard, and a tunnel between two machines",
    "docs/how-to/docker-or-cgroup.md": "docker",
    "docs/how-to/many-hosts-discovery.md": "a server at an address of its own network",
    "docs/how-to/alerts.md": "a chat; tests/unit/tools/alerts/test_page.py checks its file",
    "docs/how-to/collected-logs.md": "tests/ros/test_collected_logs.py runs a collector",
    "docs/how-to/reports.md": "its sources are long runs; tests/unit/cli/test_report.py has them",
    "docs/how-to/diagnostics.md": "`ros2` of a ROS installation",
    "docs/how-to/security.md": "`ros2 security` and DDS security, both not in the wheels",
    "docs/how-to/ubuntu-24.04-with-apt-ros.md": "apt",
    "docs/how-to/launch-files.md": "`launch` of a ROS installation, which no package index has",
    "docs/reference/metrics.md": "it ends with Ctrl-C; tests/ros/test_web_metrics.py runs it",
    "docs/how-to/documentation.md": "tests/integration/test_docs_site.py builds the site",
    "docs/evaluation.md": "40 minutes; tests/integration/test_paper.py runs its parts",
}

#: The pages with `text` blocks, and the test that compares their text; in brackets: why none does.
TEXTS: Final[Mapping[str, str]] = {
    "docs/explanation/architecture.md": "tests/unit/docs/test_code_map.py",
    "docs/how-to/artifacts.md": "(a moment of a long transfer) tests/unit/slave/test_artifacts.py",
    "docs/how-to/health.md": "tests/unit/docs/test_outputs.py",
    "docs/how-to/lifecycle-nodes.md": "tests/unit/docs/test_outputs.py",
    "docs/how-to/web.md": "(any events) tests/unit/tools/web/test_changes.py",
    "docs/how-to/wireguard.md": "(a tunnel between two machines)",
    "docs/reference/command-line.md": "tests/unit/docs/test_outputs.py",
    "docs/reference/keys.md": "tests/unit/docs/test_keys_page.py",
    "docs/reference/metrics.md": "(a file of Prometheus)",
    "docs/tutorials/your-own-filter.md": "(any host) tests/integration/plugins/test_tutorial.py",
}

BLOCK: Final = re.compile(
    r"(?:^<!-- (?P<mark>[^\n]*) -->\n)?^```(?P<language>\w+)(?P<info>[^\n]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
_PROMPT: Final = re.compile(r"^[$#] ", re.MULTILINE)
_MARKS: Final = ("not run", "sample", "until", "cluster")


@dataclass(frozen=True)
class Block:
    """A fenced block: a file with a title, or what is typed."""

    language: str
    title: str
    mark: str
    about: str
    text: str

    def commands(self) -> Iterator[tuple[str, str]]:
        """Each line that is typed, without the remark behind it, and its answer."""
        for shown in _PROMPT.split(self.text)[1:]:
            line, _, answer = shown.partition("\n")
            while line.endswith("\\"):
                more, _, answer = answer.partition("\n")
                line = line[:-1] + more.strip()
            yield re.sub(r"\s+# .*", "", line).strip(), answer.strip()


def title_of(found: re.Match[str]) -> str:
    """Return the title of a block, or an empty string."""
    title = re.search(r'title="([^"]+)"', found["info"])
    return title[1] if title else ""


def blocks(page: str) -> Iterator[Block]:
    """The files and commands of a page, in its order."""
    for found in BLOCK.finditer((ROOT / page).read_text(encoding="utf-8")):
        mark, _, about = (found["mark"] or "").partition(": ")
        known = mark if mark in _MARKS else ""
        about = about if known else ""
        yield Block(found["language"], title_of(found), known, about, found["text"])


def texts(page: str) -> list[str]:
    """Return the `text` blocks of a page."""
    return [one.text for one in blocks(page) if one.language == "text"]


def pages_with(language: str) -> set[str]:
    """The names of all pages that have a block of a language, such as `console`."""
    every = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("*/README.md")]
    names = (str(page.relative_to(ROOT)) for page in every)
    return {name for name in names if any(one.language == language for one in blocks(name))}


def run_examples(page: str, mark: str) -> None:
    """Run the Python examples of a page that have a mark, in its order, in one session."""
    shown = [one.text for one in blocks(page) if one.language == "pycon" and one.mark == mark]
    assert shown, f"{page} has no example with the mark {mark!r}"
    report = io.StringIO()
    test = doctest.DocTestParser().get_doctest("\n".join(shown), {}, page, page, 0)
    result = doctest.DocTestRunner(verbose=False).run(test, out=report.write)
    assert not result.failed, report.getvalue()


# --- answers ----------------------------------------------------------------------------------

_MASKS: Final = (
    (re.compile(r"\b\d+\.\d+\.\d+\.\d+\b"), "ADDRESS"),
    (re.compile(r"─+"), "─"),
    (re.compile(r"\b\d+(\.\d+)? ?(kB|[KMG]i?B|B|ms|s|min|h|%)(?!\w)"), "#"),
    (re.compile(r"\??\b\d+/\d+\b"), "#"),
    (re.compile(r"\b\d+(\.\d+|x)\b"), "#"),
)


def masked(text: str) -> str:
    """Replace the parts of a text that differ each time."""
    for pattern, word in _MASKS:
        text = pattern.sub(word, text)
    return "\n".join(filter(None, (" ".join(line.split()) for line in text.splitlines())))


def matches(shown: str, given: str) -> bool:
    """Return True if an answer is the one that a page shows."""
    parts = [re.escape(masked(part)) for part in shown.split("...")]
    return re.fullmatch(r"\s*.*\s*".join(parts), masked(given), re.DOTALL) is not None


# --- a reader ---------------------------------------------------------------------------------

#: What keeps its terminal until Ctrl-C.
_STAYS: Final = re.compile(r"(.* )?rosrm (--\S+ \S+ )?(up|master|slave|events -f|web)\b|.* &$")
_HOSTS: Final = re.compile(r"rosrm up\b(?:.* --hosts (\d+))?")


@dataclass
class Reader:
    """A reader who follows a page in a folder, with a terminal for each part that stays.

    Attributes:
        called: names of this machine, and what the page calls them.
        learned: pids and addresses of the page, and those of this run.
    """

    folder: Path
    domain: int
    environment: dict[str, str] = field(init=False)
    called: dict[str, str] = field(default_factory=dict)
    learned: dict[str, str] = field(default_factory=dict)
    terminals: list[tuple[str, subprocess.Popen[bytes], Path]] = field(default_factory=list)
    typed: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        kept = {
            name: value for name, value in without_bootstrapper(os.environ).items()
            if not name.startswith(("ROSRM_", "XDG_"))
        }  # fmt: skip
        self.environment = {
            **kept, "PATH": f"{Path(sys.executable).parent}:{kept.get('PATH', '')}",
            "HOME": str(self.folder / "home"), "ROS_DOMAIN_ID": str(self.domain),
            "COLUMNS": "140", "NO_COLOR": "1", "PYTHONUNBUFFERED": "1",
        }  # fmt: skip
        self.called |= {str(Path(sys.executable).parent): "/usr/bin", str(self.folder): "/home/ada"}
        (self.folder / "home").mkdir(parents=True, exist_ok=True)

    def follow(self, page: str, setup: Page) -> None:
        """Save the files of a page and type its commands; what it promises must hold."""
        self._prepare(setup)
        for block in blocks(page):
            if block.mark == "not run":
                continue
            if block.title:
                (self.folder / block.title).write_text(block.text, encoding="utf-8")
            elif block.language == "console":
                for line, answer in block.commands():
                    self.type(line, answer.partition("\n")[0] if block.mark == "sample" else answer,
                              whole=block.mark != "sample")  # fmt: skip
                if block.mark == "until":
                    self._await(block.about)

    def _prepare(self, setup: Page) -> None:
        for name, text in setup.files.items():
            (self.folder / name).write_text(text, encoding="utf-8")
        if setup.criu:  # a page writes the prefix for all users of a host
            prefix = os.environ.get("ROSRM_CRIU_PREFIX") or str(ROOT / ".venv" / "criu")
            self.environment["ROSRM_CRIU_PREFIX"] = prefix
            self.called[prefix] = "/opt/rosrm-criu"
        if setup.hosts:
            self._start_cluster(setup)
        for line in setup.before:
            self.type(line)

    def _start_cluster(self, setup: Page) -> None:
        (self.folder / "before.cluster.yaml").write_text(setup.cluster, encoding="utf-8")
        self.type("rosrm master --config before.cluster.yaml")
        for host in setup.hosts:
            budget = "{memory: 2GiB, cpu: 2.0, disk: 4GiB}"
            text = f"host: {host}\nscope: slice\nbudget: {budget}\n"
            (self.folder / f"before-{host}.host.yaml").write_text(text, encoding="utf-8")
            self.type(f"rosrm slave --config before-{host}.host.yaml")

    def type(self, line: str, answer: str = "", *, whole: bool = True) -> None:
        """Give a command, and see that it does and says what the page shows."""
        self.typed.append(line)
        for shown, here in self.learned.items():
            line = line.replace(shown, here)
        if line.startswith("export "):
            shown = dict(word.split("=", 1) for word in line.split()[1:])
            shown.pop("ROS_DOMAIN_ID", None)  # the page's may be taken on this machine
            self.environment.update(shown)
        elif _STAYS.match(line):
            self._open(line)
            if answer:
                self._await_answer(answer)
        else:
            self._ask(line, answer, whole=whole)

    def _ask(self, line: str, answer: str, *, whole: bool) -> None:
        deadline = time.monotonic() + PATIENCE
        while True:
            done = subprocess.run(
                ["bash", "-c", line], cwd=self.folder, env=self.environment, text=True,
                stdin=subprocess.DEVNULL, capture_output=True, timeout=LONG_PATIENCE, check=False,
            )  # fmt: skip
            said = done.stdout if whole else done.stdout.strip().partition("\n")[0]
            said = self._as_shown(said)
            assert "Traceback" not in done.stdout + done.stderr, self._story(line, done)
            right = not answer or matches(answer, said)
            if done.returncode == 0 and right:
                return
            changed = done.returncode == 0 and not _LOOKS.search(line)
            assert not changed and time.monotonic() < deadline, (  # noqa: PT018 - one reason
                f"{self._story(line, done)}\nthe page shows:\n{answer or 'nothing'}"
            )
            time.sleep(0.5)

    def _as_shown(self, said: str) -> str:
        """Return an output with the names, pids and addresses of the page."""
        for here, name in self.called.items():
            said = said.replace(here, name)
        for shown, here in self.learned.items():
            said = re.sub(rf"\b{re.escape(here)}\b", shown, said)
        return said

    def _open(self, line: str) -> None:
        """Start what stays, and wait until its hosts are up."""
        if line == "rosrm web":
            line += " --listen 127.0.0.1:0"
        log = self.folder / f"terminal-{len(self.terminals)}.log"
        with log.open("wb") as sink:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {line.removesuffix('&')}"], cwd=self.folder,
                env=self.environment, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink,
                start_new_session=True,
            )  # fmt: skip
        self.terminals.append((line, process, log))
        if line.endswith("&"):
            self.learned["4711"] = str(process.pid)
        if "rosrm slave" in line:
            # Of the pages' hosts the first to be started is the first to be given work.
            before = line.partition("rosrm slave")[0]
            slaves = sum("rosrm slave" in one for one, _, _ in self.terminals)
            self._await_hosts(before, slaves)
        elif up := _HOSTS.match(line):
            self._await_hosts("", int(up[1] or 1))

    def _await_hosts(self, before: str, count: int) -> None:
        """Wait until some hosts are up; `before` stands before the command of the page."""
        self._ask(f"test $({before}rosrm hosts | grep -cw up) -ge {count}", "", whole=True)

    def _await(self, text: str) -> None:
        self._await_output(lambda said: text in said, text)

    def _await_answer(self, answer: str) -> None:
        """Wait until the terminal opened last shows an answer; learn the address in it."""

        def is_there(said: str) -> bool:
            for address in re.findall(r"127\.0\.0\.1:[1-9]\d*", said):
                self.learned["127.0.0.1:8290"] = address
            return matches(f"...{answer}...", self._as_shown(said))

        self._await_output(is_there, answer)

    def _await_output(self, is_there: Callable[[str], bool], what: str) -> None:
        line, process, log = self.terminals[-1]
        deadline = time.monotonic() + LONG_PATIENCE
        while not is_there(said := log.read_text(errors="replace")):
            assert process.poll() is None, f"$ {line}\nended with {process.returncode}:\n{said}"
            assert time.monotonic() < deadline, f"$ {line}\nnever said {what!r}:\n{said}"
            time.sleep(0.2)

    def _story(self, line: str, done: subprocess.CompletedProcess[str]) -> str:
        return (
            f"$ {line}\n{done.stdout}{done.stderr}exit code {done.returncode}, after "
            f"{'; '.join(self.typed[:-1])}\n{self.said()}"
        )

    def said(self) -> str:
        """Return the ends of the outputs of all terminals."""
        return "\n".join(
            f"--- {line}\n{log.read_text(errors='replace')[-3000:]}"
            for line, _, log in self.terminals
        )

    def close(self) -> None:
        """Press Ctrl-C in each terminal, the newest first, as a page asks for at its end."""
        for _, process, _ in reversed(self.terminals):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait(PATIENCE)
        assert "Traceback" not in self.said(), self.said()


#: Commands that change nothing, and are given again until they show what the page does.
_LOOKS: Final = re.compile(
    r"rosrm (lab )?(ps|hosts|status|explain|events|logs|top|apps|history)\b|^curl -s http"
)
