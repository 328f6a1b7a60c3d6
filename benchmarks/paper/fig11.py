"""Fig. 11: one map, made before and after the move of the SLAM that maps.

The migration demo (`rosrm_examples.demo_migration`) is measured as it is: the host of the SLAM
reaches its limit of memory in mid-drive, and rosrm moves the SLAM with its map.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks.machine import say
from benchmarks.paper.labs import ROOT, Failed
from benchmarks.paper.report import Options, Result
from rosrm_examples.migration_results import differences

CLAIM: Final = (
    "A SLAM that migrates in mid-drive continues its map on the other host: no scan is lost or "
    "mapped twice, and the map is that of a drive without a move"
)
#: Drive of a small run, and seconds after which a measurement is given up.
_LITTLE: Final = "street:24"
_LONGEST: Final = 600.0
#: Exit statuses of a demo that wrote its results.
_MEASURED: Final = (0, 1)


def measure(options: Options) -> Result:
    """Run the migration demo on the first of the drives."""
    out = options.folder / "demo"
    drives = (_LITTLE,) if options.small else options.drives[:1]
    command = [sys.executable, "-m", "rosrm_examples.demo_migration", "--out", str(out)]
    log = options.folder / "demo.log"
    with log.open("w") as sink:
        ended = subprocess.run(
            [*command, *(word for drive in drives for word in ("--drive", drive))],
            check=False, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink,
            timeout=_LONGEST,
        )  # fmt: skip
    summary = out / "summary.json"
    if ended.returncode not in _MEASURED or not summary.exists():
        last = "\n  ".join(log.read_text(errors="replace").strip().splitlines()[-5:])
        raise Failed(f"the demo ended with exit code {ended.returncode}:\n  {last}")
    figures: dict[str, Any] = json.loads(summary.read_text())
    say(f"fig11: {figures['scans_processed']} of {figures['scans_sent']} scans mapped")
    wrong = differences(figures, "full", migrations=1)
    return Result(wrong, figures, _SCALED, partial(_draw, out / "map.png"), source=out)


def _draw(picture: Path, path: Path) -> None:
    shutil.copyfile(picture, path)


_SCALED: Final = {
    "hosts": "three slaves on one machine, each with a budget of memory (scope slice)",
    "drive": "a part of a KITTI drive or of a simulated street, played in real time",
}
