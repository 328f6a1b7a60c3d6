"""Take the pictures of the page for the docs, while a demo runs: `make screenshots`.

The pictures are docs/pictures/page-*.png. Needs Chromium.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.browser import CHROMIUM, MISSING, browser
from benchmarks.hosts import three_hosts
from benchmarks.stopping import own_keys
from benchmarks.web import gateway
from rosrm import Client
from rosrm.testing.local_cluster import LocalCluster

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "pictures"
OUT = ROOT / "out" / "screenshots"
#: Line of the demo with the address of its page.
ADDRESS = re.compile(r"the page of this cluster, .*: (http\S+)")
#: Line of the demo once the hosts are full and the queue waits.
BUSY = re.compile(r"^ +\d+ s .* (?:[2-9]|\d\d) wait")
#: Line of the demo about the move of a process off a full host.
MOVED = re.compile(r" moves from ")
#: Milliseconds for the page to show something.
PATIENCE = 60_000


class Picture(NamedTuple):
    """A picture: what is done on the page before it is taken, and how the browser looks."""

    name: str
    prepare: Callable[[Any], None]
    width: int = 1280
    height: int = 800
    scheme: str = "light"
    token: str = ""  # of an operator; "": the page asks for none


def main() -> int:
    """Run a demo and take all pictures; return the exit status."""
    if CHROMIUM is None:
        print(f"screenshots: {MISSING}", file=sys.stderr)
        return 2
    OUT.parent.mkdir(exist_ok=True)
    demo = subprocess.Popen(
        [sys.executable, "-m", "rosrm_examples.demo", "--out", str(OUT), "--pace", "0.5"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    try:
        url = wait_for(demo, ADDRESS)[1]
        wait_for(demo, BUSY)
        with browser() as chromium:
            for one in PICTURES_OF_A_FULL_QUEUE:
                take(chromium, url, one)
            wait_for(demo, MOVED)
            take(chromium, url, TIMELINE)
    finally:
        demo.terminate()
        demo.communicate()
    with own_keys(), browser() as chromium, tempfile.TemporaryDirectory() as folder:
        take_plan(chromium, Path(folder))
    return 0


def take_plan(chromium: Any, folder: Path) -> None:
    """Take the plan of a change, on a cluster of its own: the page of a demo only reads."""
    (folder / "work.yaml").write_text(VERSIONS[0], encoding="utf-8")
    tokens = folder / "tokens"
    tokens.touch(0o600)
    tokens.write_text(f"operator ada {PLAN.token}\n", encoding="ascii")
    with LocalCluster(folder / "cluster", hosts=three_hosts()) as cluster:
        client = Client(connection=cluster.client)
        client.apply([folder / "work.yaml"])
        client.wait_for_applications(["navigation"], timeout=PATIENCE / 1000)
        words = ("--tokens", str(tokens), "--allow-actions")
        with gateway(cluster, *words) as (_, port):
            take(chromium, f"http://127.0.0.1:{port}/", PLAN)


def wait_for(demo: subprocess.Popen[str], what: re.Pattern[str]) -> re.Match[str]:
    """Return the next line of the demo that matches; raises `RuntimeError` where it ends."""
    assert demo.stdout is not None
    for line in demo.stdout:
        if found := what.search(line):
            return found
    raise RuntimeError(f"the demo ended with exit code {demo.wait()} before {what.pattern!r}")


def take(chromium: Any, url: str, picture: Picture) -> None:
    """Open the page, prepare it, and write a picture."""
    size = {"width": picture.width, "height": picture.height}
    context = chromium.new_context(viewport=size, color_scheme=picture.scheme)
    context.set_default_timeout(PATIENCE)
    page = context.new_page()
    page.goto(url)
    if picture.token:
        page.get_by_label("Token").fill(picture.token)
        page.get_by_role("button", name="Log in").click()
    page.locator(".ag-row:visible").first.wait_for()
    picture.prepare(page)
    page.wait_for_load_state("networkidle")
    path = PICTURES / f"page-{picture.name}.png"
    page.screenshot(path=path, animations="disabled")
    print(path.relative_to(ROOT), flush=True)
    context.close()


def open_tab(page: Any, name: str) -> None:
    """Show a tab with a table."""
    page.get_by_role("tab", name=name).click()
    page.locator(".ag-row:visible").first.wait_for()


def open_processes(page: Any) -> None:
    """Show the processes as a tree."""
    open_tab(page, "Processes")
    page.get_by_role("button", name="Expand all").click()
    page.locator(".ag-row:visible", has_text="piece_01").wait_for()


def open_timeline(page: Any) -> None:
    """Show the timeline."""
    page.get_by_role("tab", name="Timeline").click()
    page.get_by_role("button", name="1 min").click()
    page.locator("svg text", has_text="host3").first.wait_for()
    page.locator(".rosrm-marks .ag-row:visible").first.wait_for()


def open_process(page: Any, name: str = "holder_20") -> None:
    """Open the dialog of a process, by default of one that was assigned to busy hosts."""
    open_tab(page, "Processes")
    page.get_by_label("Search processes").fill(name)
    page.locator(".ag-row:visible", has_text=name).first.dblclick()
    page.get_by_role("dialog").get_by_role("cell", name="chosen").wait_for()


def open_logs(page: Any) -> None:
    """Open the log of a process; without the lines that have paths of this machine."""
    open_process(page, "piece_01")
    page.get_by_role("dialog").get_by_role("tab", name="Logs").click()
    page.get_by_label("Show only lines with").fill(" of CPU")
    page.get_by_role("dialog").get_by_text("s of CPU a scan").first.wait_for()
    page.get_by_role("dialog").get_by_text("wrote").wait_for(state="detached")


def open_plan(page: Any) -> None:
    """Plan the second version of an application."""
    open_tab(page, "Applications")
    page.get_by_role("button", name="Plan a change").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Work file", exact=True).fill(VERSIONS[1])
    dialog.get_by_role("button", name="Plan", exact=True).click()
    dialog.get_by_role("button", name="Apply:").wait_for()


#: An application, and its next version.
VERSIONS = (
    """app: navigation
processes:
  - {name: planner, command: sleep 1000}
  - {name: mapper, command: sleep 1000}
""",
    """app: navigation
processes:
  - {name: planner, command: sleep 2000}
  - {name: camera, command: sleep 1000}
  - {name: giant, command: sleep 1000, needs: {memory: 90GiB}}
""",
)
PICTURES_OF_A_FULL_QUEUE = (
    Picture("hosts", lambda _: None, height=420),
    Picture("processes", open_processes),
    Picture("applications", lambda page: open_tab(page, "Applications"), height=420),
    Picture("explain", open_process),
    Picture("logs", open_logs),
    Picture("events", lambda page: open_tab(page, "Events"), height=560, scheme="dark"),
    Picture("phone", open_processes, width=390, height=700),
)
TIMELINE = Picture("timeline", open_timeline)
PLAN = Picture("plan", open_plan, token="0123456789abcdef" * 2)


if __name__ == "__main__":
    sys.exit(main())
