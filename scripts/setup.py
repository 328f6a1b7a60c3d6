"""Make `.venv`: what the demos need, and with `--tests` what tests and benchmarks need too.

Run by the Python that the environment is made from, with the standard library alone. A stamp in
`.venv` holds digests of its contents, so that a finished step is not repeated. The compiled ROS
interfaces are cached outside of `.venv`, because they take longer than all other steps together.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import importlib.util
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
CRIU = VENV / "criu"  # the same path as in tests/conftest.py and the Makefile
INSTALL_CRIU = ROOT / "scripts" / "install_criu.sh"
LOG = VENV / "setup.log"
STAMP = VENV / "rosrm-setup.json"
#: Packages of ROS interfaces, and the title of the step that builds each.
INTERFACES = {
    ROOT / "rosrm_msgs": "the ROS interfaces: generated and compiled, about a minute",
    ROOT / "composition_interfaces": "the services of component containers: the same, half as long",
}
CONSTRAINTS = ROOT / "constraints.txt"

#: The Python versions with ROS 2 Jazzy wheels.
OLDEST, NEWEST = (3, 10), (3, 13)

#: Program for the environment: rclpy finds the compiled interfaces.
IMPORTS = "import rclpy, rosrm, rosrm_msgs.msg as m; m.ResourceInfo.__import_type_support__()"

#: Lines of pip, CMake and ninja that show their progress.
PROGRESS = re.compile(
    r"^\s*(?P<step>Collecting \S+|Downloading \S+|Obtaining \S+|Building wheel for \S+|"
    r"Installing \S+ dependencies|Installing collected packages|\[\d+/\d+\] .*)"
)

#: Pip prints one of these when a pin does not fit. Before it gives up, it may try all versions of
#: the packages around that pin for minutes, which cannot succeed with exact pins.
REFUSED = re.compile(
    r"pip is looking at multiple versions of |ResolutionImpossible|resolution-too-deep"
)


class SetupError(Exception):
    """An error for the user: what is wrong, where, and what to do about it."""


def main() -> int:
    """Make or repair the environment, and print each step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--chosen", action="store_true", help="replace a .venv of another Python version"
    )
    parser.add_argument(
        "--tests", action="store_true", help="install what tests and benchmarks need, too"
    )
    options = parser.parse_args()
    with Path(__file__).open() as lock:
        wait_for(lock.fileno())
        try:
            set_up(remake_other_version=options.chosen, tests=options.tests)
        except SetupError as error:
            print(f"\nmake setup: {error}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            print("\nmake setup: interrupted; run it again to continue", file=sys.stderr)
            return 130
    return 0


def wait_for(lock: int) -> None:
    """Let one run at a time work on the environment."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print("Another `make setup` is at work here: waiting for it.", flush=True)
        fcntl.flock(lock, fcntl.LOCK_EX)


def set_up(*, remake_other_version: bool, tests: bool) -> None:
    """Run the unfinished steps."""
    packages = packages_digest()
    wanted = {
        "where": str(VENV),
        "interfaces": interfaces_digest(*INTERFACES),
        "packages": packages,
    }
    if tests:
        wanted["tests"] = packages
    if not venv_usable(remake_other_version=remake_other_version):
        check_machine()
        make_venv()
    missing = {part for part, state in wanted.items() if read_stamp().get(part) != state}
    if not missing:
        return
    check_machine()
    began = time.monotonic()
    steps = Steps()
    steps.run("pip and the build backends", *pip("install", *BACKENDS))
    if "interfaces" in missing:
        for source, what in INTERFACES.items():
            install_interfaces(steps, source, what)
        stamp(wanted, "interfaces")
    if "packages" in missing:
        steps.run(
            "ROS 2 Jazzy, rosrm, its plugins and examples",
            *pip("install", "--no-build-isolation", *editables(extras="ros")),
        )
        steps.run("a check that they work together", PYTHON, "-c", IMPORTS)
        stamp(wanted, "packages")
    if "tests" in missing:
        steps.run(
            "the tools for tests and benchmarks",
            *pip("install", "--no-build-isolation", *editables(extras="ros,test")),
        )
        try_criu(steps)
        stamp(wanted, "tests")
    print(f"      .venv is ready ({time.monotonic() - began:.0f} s in all)", flush=True)


def install_interfaces(steps: Steps, source: Path, what: str) -> None:
    """Install compiled ROS interfaces, from the cache if they were built before."""
    content = interfaces_digest(source)
    folder = cache_folder() / f"{content[:16]}-{sysconfig.get_platform()}-{short_version()}"
    if not any(folder.glob("*.whl")):
        with tempfile.TemporaryDirectory(dir=folder.parent) as built:
            steps.run(
                what,
                *pip("wheel", "--no-deps", "--build-constraint", CONSTRAINTS),
                *("--verbose", "--wheel-dir", built, source),  # for the progress
            )
            wheel = next(Path(built).glob("*.whl"))
            folder.mkdir(exist_ok=True)
            wheel.replace(folder / wheel.name)  # whole, or not at all
    wheel = next(folder.glob("*.whl"))
    steps.run(
        f"compiled: {source.name}",
        *pip("install", "--force-reinstall", "--no-deps", wheel),
    )


def cache_folder() -> Path:
    """Return the user's cache of compiled interfaces; it may be removed at any time."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    cache = caches / "rosrm" / "interfaces"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:  # a user without a home
        cache = VENV / "interfaces"
        cache.mkdir(exist_ok=True)
    return cache


def try_criu(steps: Steps) -> None:
    """Install CRIU into the environment, if available; without it its tests are skipped."""
    try:
        steps.run("CRIU, if there is one for this machine", INSTALL_CRIU, CRIU)
    except SetupError as error:
        last = str(error).strip().splitlines()[-1].removeprefix("install_criu: ")
        print(f"      without CRIU; what needs it is skipped in the tests. {last}")
        script, folder = INSTALL_CRIU.relative_to(ROOT), CRIU.relative_to(ROOT)
        print(f"      To try again: {script} {folder}")


# ----------------------------------------------------------------------------- present state


def interfaces_digest(*sources: Path) -> str:
    """Return a digest of all files that the builds of these packages read."""
    files = [
        path
        for source in (*sources, ROOT / "rosrm_msgs" / "cmake")
        for path in source.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    return digest([*set(files), CONSTRAINTS])


def packages_digest() -> str:
    """Return a digest of all files that determine the packages of the environment."""
    scripts = (Path(__file__), INSTALL_CRIU)
    return digest([CONSTRAINTS, *scripts, *(d / "pyproject.toml" for d in distributions())])


def digest(files: list[Path]) -> str:
    """Return the SHA-256 of names and contents."""
    total = hashlib.sha256()
    for path in sorted(files):
        content = path.read_bytes()
        total.update(f"{path.relative_to(ROOT)} {len(content)}\n".encode())
        total.update(content)
    return total.hexdigest()


def distributions() -> list[Path]:
    """Return the folders of the repository's own distributions, the core first."""
    others = [*sorted(ROOT.glob("plugins/*")), *sorted(ROOT.glob("tools/*")), ROOT / "examples"]
    return [ROOT, *(d for d in others if (d / "pyproject.toml").is_file())]


def venv_usable(*, remake_other_version: bool) -> bool:
    """Return True if `.venv` works in this folder, and with the chosen Python version."""
    if not PYTHON.exists():
        return False
    probe = "import sys; print(*sys.version_info[:2], sys.prefix)"
    answer = subprocess.run([PYTHON, "-c", probe], capture_output=True, text=True, check=False)
    major, minor, prefix = (*answer.stdout.strip().split(" ", 2), "", "", "")[:3]
    where = read_stamp().get("where", prefix)  # its commands contain the folder where it was made
    if answer.returncode != 0 or not Path(prefix) == Path(where) == VENV:
        print("      .venv was made elsewhere or is broken: it is replaced")
        return False
    if remake_other_version and (major, minor) != tuple(map(str, sys.version_info[:2])):
        print(f"      .venv has Python {major}.{minor}, and not {short_version()}: it is replaced")
        return False
    return True


def read_stamp() -> dict[str, str]:
    """Return the digests of the finished parts of the environment; empty: none."""
    try:
        stamp = json.loads(STAMP.read_text())
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def stamp(wanted: dict[str, str], part: str) -> None:
    """Record that a part of the environment is finished."""
    write_stamp({**read_stamp(), "where": wanted["where"], part: wanted[part]})


def write_stamp(done: dict[str, str]) -> None:
    """Write the digests of the finished parts."""
    STAMP.write_text(json.dumps(done, indent=2) + "\n")


# ---------------------------------------------------------------------------- requirements


def check_machine() -> None:
    """Raise `SetupError`, with the remedy, on a machine on which a later step would fail."""
    if not OLDEST <= sys.version_info[:2] <= NEWEST:
        candidates = [f"python3.{m}" for m in range(NEWEST[1], OLDEST[1] - 1, -1)]
        found = next((name for name in candidates if shutil.which(name)), None)
        hint = f"make setup PYTHON={found}" if found else "install one of them: PYTHON=/path/to/it"
        raise SetupError(
            f"{sys.executable} is Python {short_version()}; the ROS 2 Jazzy wheels are for 3.10 to "
            f"3.13. {hint}"
        )
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise SetupError(
            f"the ROS 2 Jazzy wheels are for Linux on x86-64, this is {sys.platform} on "
            f"{platform.machine()}. With ROS 2 installed (apt), follow the README instead."
        )
    missing = []
    if not importlib.util.find_spec("venv") or not importlib.util.find_spec("ensurepip"):
        missing.append(("Python's venv module (with ensurepip)", "python3-venv"))
    if not any(map(shutil.which, filter(None, [os.environ.get("CC"), "cc", "gcc", "clang"]))):
        missing.append(("a C compiler", "gcc"))
    if not any(map(shutil.which, filter(None, [os.environ.get("CXX"), "c++", "g++", "clang++"]))):
        missing.append(("a C++ compiler", "g++"))
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        missing.append((f"the headers of Python {short_version()} (Python.h)", "python3-dev"))
    if missing:
        raise SetupError(
            f"missing: {', '.join(what for what, _ in missing)}. On Debian or Ubuntu: "
            f"sudo apt install {' '.join(package for _, package in missing)}"
        )


def short_version() -> str:
    """Return the version of this Python, as in `3.12`."""
    return ".".join(map(str, sys.version_info[:2]))


# --------------------------------------------------------------------------------- the steps


def make_venv() -> None:
    """Make `.venv` from the Python that runs this."""
    print(f"      .venv from {sys.executable} (Python {platform.python_version()})", flush=True)
    shutil.rmtree(VENV, ignore_errors=True)
    made = subprocess.run(
        [sys.executable, "-m", "venv", VENV], capture_output=True, text=True, check=False
    )
    if made.returncode != 0:
        raise SetupError(f"python -m venv failed:\n{made.stdout}{made.stderr}")
    write_stamp({"where": str(VENV)})


#: Installed first, so that rosrm's own distributions need no build environments.
BACKENDS = ("pip", "hatchling", "editables", "setuptools")


def pip(command: str, *arguments: object) -> tuple[object, ...]:
    """Return a pip command of the environment, constrained to the exact versions."""
    return (PYTHON, "-m", "pip", command, "--constraint", CONSTRAINTS, *arguments)


def editables(*, extras: str) -> list[object]:
    """Return arguments that install the repository's distributions in editable mode."""
    arguments: list[object] = []
    for folder in distributions():
        arguments += ["--editable", f"{folder}[{extras}]" if folder == ROOT else folder]
    return arguments


def pin_that_does_not_fit() -> str:
    """Return which pin pip cannot install on this Python, for the user.

    Without dependencies pip looks each pin up once, in some seconds, and names the one that fails.
    """
    words = ("install", "--dry-run", "--no-deps", "--ignore-installed", "--requirement")
    command = [str(word) for word in (PYTHON, "-m", "pip", *words, CONSTRAINTS)]
    try:
        found = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=45
        ).stderr
    except subprocess.TimeoutExpired:
        return f"pip finds no versions that fit {CONSTRAINTS.name}; which pin fails: {LOG}"
    failed = re.search(r"No matching distribution found for (?P<pin>\S+==(?P<version>\S+))", found)
    if failed is None:
        return (
            f"pip finds no versions that fit {CONSTRAINTS.name}, although each pin alone can be "
            "installed. Does another constraint apply (`pip config list`, PIP_CONSTRAINT)?"
        )
    needs = re.search(rf"\b{re.escape(failed['version'])} Requires-Python (?P<what>[^;\n]+)", found)
    reason = f"needs Python {needs['what']}" if needs else "is not in the package index"
    return (
        f"{failed['pin']} of {CONSTRAINTS.name} {reason}, and this is Python "
        f"{platform.python_version()} ({sys.executable}). Choose another one: "
        "make setup PYTHON=/path/to/it. Please report this: every pin should fit this Python."
    )


class Steps:
    """A runner of commands, one after another, with their progress."""

    def __init__(self) -> None:
        self.number = 0
        LOG.write_text("")

    def run(self, title: str, *command: object) -> None:
        """Run one command; its output goes to the log, its progress to the terminal."""
        self.number += 1
        print(f"[{self.number}] {title}", flush=True)
        began = time.monotonic()
        last_lines: deque[str] = deque(maxlen=30)
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
        with (
            LOG.open("a") as log,
            subprocess.Popen(
                [str(word) for word in command],
                cwd=ROOT,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,
            ) as process,
            ended_with_us(process),
        ):
            progress = ProgressLine(began)
            for line in process.stdout or ():
                log.write(line)
                last_lines.append(line)
                progress.show(line)
                if REFUSED.search(line):
                    progress.clear()
                    raise SetupError(pin_that_does_not_fit())
            progress.clear()
        if process.returncode != 0:
            raise SetupError(
                f"this failed: {title}. Its last lines (all of them are in "
                f"{LOG.relative_to(ROOT)}):\n\n{''.join(last_lines)}"
            )
        print(f"      done in {time.monotonic() - began:.0f} s", flush=True)


@contextlib.contextmanager
def ended_with_us(process: subprocess.Popen[str]) -> Iterator[None]:
    """End a command, with its compilers, where this run is interrupted."""
    try:
        yield
    except BaseException:  # an interrupt above all
        for how, grace in ((signal.SIGINT, 5.0), (signal.SIGKILL, None)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, how)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(grace)
        raise


class ProgressLine:
    """The progress of a command: updated in place on a terminal, else printed every 10 s."""

    def __init__(self, began: float) -> None:
        self.began = began
        self.terminal = sys.stdout.isatty()
        self.shown = began

    def show(self, line: str) -> None:
        """Show a line of output if it contains the progress."""
        match = PROGRESS.match(line)
        now = time.monotonic()
        if match is None or now - self.shown < (0.1 if self.terminal else 10.0):
            return
        self.shown = now
        text = f"      {now - self.began:3.0f} s  {match['step']}"
        if self.terminal:
            width = shutil.get_terminal_size().columns - 1
            print(f"\r\033[K{text[:width]}", end="", flush=True)
        else:
            print(text[:100], flush=True)

    def clear(self) -> None:
        """Clear the line for the next output."""
        if self.terminal:
            print("\r\033[K", end="", flush=True)


if __name__ == "__main__":
    sys.exit(main())
