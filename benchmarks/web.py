"""Cost of the HTTP gateway beside a master with 100 hosts and 2,000 processes.

The master is real, the slaves are simulated (`benchmarks/simulated_slaves.py`), and `rosrm web` is
the real command with one reader of `/v1/changes`. The browser is Chromium, driven by Playwright:

- `hosts_ms`, `processes_ms`, `metrics_ms`: median time of an answer over HTTP.
- `stream_ms`: median time from a request to the master until its event is in the stream.
- `first_paint_ms`: median time from the begin of the navigation, with an empty cache, until the
  first rows of the table of hosts are drawn; `again_ms`: the same with a filled cache.
- `tab_ms`: time from the click on the tab of the processes until their first rows are drawn.
- `update_ms`: median time from a request to the master until the page shows the change.
- `idle_cpu`: cores that the gateway uses with a page open while nothing changes; `pss_mib`: its
  memory then.
"""

from __future__ import annotations

import argparse
import http.client
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import psutil
from playwright.sync_api import Browser, Page

from benchmarks.browser import browser
from benchmarks.machine import parser, print_report
from benchmarks.scale import occupied_cluster
from benchmarks.slave_cost import pss_mib
from benchmarks.stopping import run
from rosrm.errors import RosrmError
from rosrm.testing.local_cluster import LocalCluster

#: Requests for each time of an answer.
_REQUESTS = 10
#: Seconds between two requests, beyond the time for which the gateway uses a listing again.
_PAUSE = 0.3
_PATIENCE = 120.0
#: Openings of the page for `first_paint_ms`.
_PAINTS = 5
#: In the page: the milliseconds since its navigation once rows are there, after the next frame.
_DRAWN = """() => document.querySelector('[aria-label=Hosts] .ag-row .ag-cell')
    && new Promise(done => requestAnimationFrame(() => done(performance.now())))"""
_TAB_DRAWN = "() => document.querySelector('[aria-label=Processes] .ag-row .ag-cell')"
_CORDONED = """host => [...document.querySelectorAll('[aria-label=Hosts] .ag-row')]
    .some(row => row.textContent.includes(host) && row.textContent.includes('cordoned'))"""


@contextmanager
def gateway(cluster: LocalCluster, *words: str) -> Iterator[tuple[psutil.Process, int]]:
    """Yield the process and the port of a gateway for a cluster; `words`: its further options."""
    with subprocess.Popen(
        [sys.executable, "-m", "rosrm.cli", "web", "--listen", "127.0.0.1:0", *words], text=True,
        env={**os.environ, **cluster.ros.environment()}, stdout=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            lines = (line for line in process.stdout if line.startswith("rosrm web: "))
            address = urlsplit(next(lines).split()[2].rstrip(";"))
            yield psutil.Process(process.pid), int(address.port or 0)
        finally:
            process.send_signal(signal.SIGINT)


def answer_ms(port: int, path: str) -> float:
    """Return the median time of an answer.

    Raises:
        RosrmError: the answer is an error.
    """
    took = []
    for _ in range(_REQUESTS):
        time.sleep(_PAUSE)
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
        begun = time.monotonic()
        connection.request("GET", path)
        answer = connection.getresponse()
        content = answer.read()
        took.append(1e3 * (time.monotonic() - begun))
        connection.close()
        if answer.status != 200:
            raise RosrmError(f"{path}: {answer.status}: {content[:300]!r}")
    return statistics.median(took)


def stream_ms(cluster: LocalCluster, stream: http.client.HTTPResponse) -> float:
    """Return the median time from a request until its event is in the stream."""
    took = []
    for number in range(_REQUESTS):
        host = f"sim{number + 1:05d}"
        begun = time.monotonic()
        cluster.client.set_host_state(host, "cordon")
        while b'"host_cordoned"' not in stream.readline():
            pass
        took.append(1e3 * (time.monotonic() - begun))
        cluster.client.set_host_state(host, "uncordon")
    return statistics.median(took)


def paint_ms(page: Page, url: str) -> float:
    """Return the time from the begin of the navigation until rows of the first table are drawn."""
    page.goto(url, wait_until="commit")
    return float(page.wait_for_function(_DRAWN, timeout=1e3 * _PATIENCE).json_value())


def of_page(cluster: LocalCluster, page: Page, number: int) -> float:
    """Return the time from a request until the page shows its effect on a host."""
    host, begun = f"sim{number + 1:05d}", time.monotonic()
    cluster.client.set_host_state(host, "cordon")
    page.wait_for_function(_CORDONED, arg=host, timeout=1e3 * _PATIENCE)
    took = 1e3 * (time.monotonic() - begun)
    cluster.client.set_host_state(host, "uncordon")
    return took


def in_browser(cluster: LocalCluster, chromium: Browser, url: str) -> tuple[Page, dict[str, float]]:
    """Return an open page, and what the browser measured."""
    cold, warm = [], []
    for _ in range(_PAINTS):
        page = chromium.new_context().new_page()
        cold.append(paint_ms(page, url))
        warm.append(paint_ms(page, url))
        page.context.close()
    page = chromium.new_context(viewport={"width": 1280, "height": 4000}).new_page()
    paint_ms(page, url)
    updates = [of_page(cluster, page, number) for number in range(_REQUESTS)]
    begun = time.monotonic()
    page.get_by_role("tab", name="Processes").click()
    page.wait_for_function(_TAB_DRAWN, timeout=1e3 * _PATIENCE)
    return page, {
        "first_paint_ms": statistics.median(cold),
        "again_ms": statistics.median(warm),
        "update_ms": statistics.median(updates),
        "tab_ms": 1e3 * (time.monotonic() - begun),
    }


def measure(arguments: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Return all figures of one run; raises `RosrmError` if a part ends or does not answer."""
    with ExitStack() as opened:
        cluster, _ = occupied_cluster(
            opened, folder, arguments.hosts, arguments.processes, 0.0, _PATIENCE
        )
        process, port = opened.enter_context(gateway(cluster))
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
        opened.callback(connection.close)
        connection.request("GET", "/v1/changes")
        stream = connection.getresponse()
        figures = {
            "hosts_ms": answer_ms(port, "/v1/hosts"),
            "processes_ms": answer_ms(port, "/v1/processes"),
            "metrics_ms": answer_ms(port, "/metrics"),
            "stream_ms": stream_ms(cluster, stream),
        }
        chromium = opened.enter_context(browser())
        _page, seen = in_browser(cluster, chromium, f"http://127.0.0.1:{port}/")
        figures |= seen
        before, begun = sum(process.cpu_times()[:2]), time.monotonic()
        time.sleep(arguments.seconds)
        used = sum(process.cpu_times()[:2]) - before
        return {
            **figures,
            "idle_cpu": used / (time.monotonic() - begun),
            "pss_mib": pss_mib([process]),
        }


def main() -> int:
    """Measure and print one JSON object; return the exit status."""
    command_line = parser(__doc__)
    command_line.add_argument("--hosts", type=int, default=100, help="number of simulated slaves")
    command_line.add_argument("--processes", type=int, default=2000, help="number of processes")
    command_line.add_argument(
        "--seconds", type=float, default=30.0, help="seconds for `idle_cpu`"
    )  # fmt: skip
    arguments = command_line.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(arguments, Path(folder))
    print_report("web", {**vars(arguments), **figures}, runs=1)
    return 0


if __name__ == "__main__":
    sys.exit(run("web", main))
