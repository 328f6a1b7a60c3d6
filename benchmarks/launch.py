"""Resolution and translation of a launch file with 300 nodes, with the `launch` of this machine.

For an XML file and a Python file, each node with two parameters and a remapping, the median of
`--runs`:

- `resolve_s`: from the start of the process that resolves the file to the checked model, and
  `resolve_cpu_s`, its CPU time; `start_s`: the same for a file with one node, which is mostly the
  imports of `launch` and `launch_ros`.
- `translate_s`: from the model to the checked application.
- `command_s`: `rosrm launch FILE --yaml` from start to end.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Final

from benchmarks.machine import parser, print_report, say
from benchmarks.stopping import run
from rosrm.config.work import checked_work
from rosrm.extensions.registry import Registry
from rosrm_launch.beside import completed
from rosrm_launch.model import LaunchModel
from rosrm_launch.running import resolve
from rosrm_launch.translate import translated

_NODES: Final = 300
_NAMESPACES: Final = 10
_TIMEOUT: Final = 120.0
_GOAL: Final = 2.0
_XML_NODE: Final = """\
  <node pkg="demo" exec="talker" name="talker_{number}" namespace="group_{group}" output="screen">
    <param name="rate" value="{number}.0"/>
    <param name="frame" value="base_{number}"/>
    <remap from="chatter" to="chatter_{number}"/>
  </node>
"""
_PYTHON: Final = """\
from launch import LaunchDescription
from launch_ros.actions import Node

def generate_launch_description():
    return LaunchDescription([
        Node(
            package="demo", executable="talker", name=f"talker_{number}",
            namespace=f"group_{number % GROUPS}", output="screen",
            parameters=[{"rate": float(number), "frame": f"base_{number}"}],
            remappings=[("chatter", f"chatter_{number}")],
        )
        for number in range(NODES)
    ])
"""


def write(folder: Path, nodes: int) -> list[Path]:
    """Write the launch files, and return their paths."""
    entries = [
        _XML_NODE.format(number=number, group=number % _NAMESPACES) for number in range(nodes)
    ]
    texts = {
        f"xml_{nodes}.launch.xml": f"<launch>\n{''.join(entries)}</launch>\n",
        f"python_{nodes}.launch.py": f"NODES, GROUPS = {nodes}, {_NAMESPACES}\n{_PYTHON}",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return [folder / name for name in texts]


def resolved(file: Path) -> tuple[LaunchModel, float, float]:
    """Return the model of a file, and the seconds and CPU seconds of its resolution."""
    began, cpu = time.perf_counter(), _cpu_of_children()
    model = resolve(file, [], timeout=_TIMEOUT)
    return model, time.perf_counter() - began, _cpu_of_children() - cpu


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def translation(model: LaunchModel, file: Path, registry: Registry) -> float:
    """Return the seconds from a model to its checked application."""
    began = time.perf_counter()
    checked_work(completed(translated(model), file, None), file, registry)
    return time.perf_counter() - began


def command(file: Path) -> float:
    """Return the seconds of the whole command, which prints a work file."""
    began = time.perf_counter()
    words = [str(Path(sys.executable).with_name("rosrm")), "launch", str(file), "--yaml"]
    subprocess.run(words, stdout=subprocess.DEVNULL, check=True, timeout=_TIMEOUT)
    return time.perf_counter() - began


def measure(file: Path, small: Path, runs: int) -> dict[str, float]:
    """Return the figures of one kind of launch file; `small` is one of a single node."""
    registry = Registry.discover()
    found: dict[str, list[float]] = {}
    for _ in range(runs):
        model, seconds, cpu = resolved(file)
        one = {
            "resolve_s": seconds, "resolve_cpu_s": cpu, "start_s": resolved(small)[1],
            "translate_s": translation(model, file, registry), "command_s": command(file),
        }  # fmt: skip
        for name, value in one.items():
            found.setdefault(name, []).append(value)
    return {name: round(median(values), 3) for name, values in found.items()}


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=9, help="of each measurement")
    options = command_line.parse_args()
    os.environ["PYTHONSAFEPATH"] = "1"
    with tempfile.TemporaryDirectory(prefix="rosrm-bench-") as folder:
        large, small = write(Path(folder), _NODES), write(Path(folder), 1)
        figures = {}
        for file, single in zip(large, small, strict=True):
            kind = file.name.partition("_")[0]
            figures[kind] = measure(file, single, options.runs)
            say(f"{kind}: {figures[kind]}")
    reached = all(one["resolve_s"] < _GOAL for one in figures.values())
    print_report(
        "launch", {"nodes": _NODES, **figures, "goal_s": _GOAL, "reached": reached},
        runs=options.runs,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("launch", main))
