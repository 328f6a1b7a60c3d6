"""The C++ core of `rosrm_node_cpp`, compiled with the bridge of this folder; loaded by ctypes."""

from __future__ import annotations

import ctypes
import fcntl
import importlib.util
import os
import subprocess
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, Final

import pytest

from tests.programs import require

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGE: Final = ROOT / "rosrm_node_cpp"
STUBS: Final = Path(__file__).parent / "stubs"
#: Warnings are errors, also in the stubs.
FLAGS: Final = (
    "-std=c++17",
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Werror",
    "-fPIC",
    "-D_GLIBCXX_ASSERTIONS",
)
INCLUDES: Final = (f"-I{PACKAGE / 'include'}", f"-I{STUBS}")
#: Names the compiled library for processes that a test starts.
VARIABLE: Final = "ROSRM_TEST_CPP_CORE"


def run_compiler(*arguments: str) -> None:
    """Compile; raise `RuntimeError` with the compiler's text if that fails."""
    command = ["g++", *FLAGS, *INCLUDES, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr[-4000:])


@cache
def library_in(folder: Path) -> Path:
    """Return the library of the core, compiled in a folder."""
    bridge = Path(__file__).with_name("bridge.cpp")
    return library_of([*sorted((PACKAGE / "src/core").glob("*.cpp")), bridge], folder)


def library_of(sources: Iterable[Path], folder: Path) -> Path:
    """Return a library, compiled in a folder unless that has it."""
    path = folder / "libcore.so"
    if path.exists():
        return path
    # One unit, because the headers of the standard library take more time than the core itself.
    unit = folder / "unit.cpp"
    unit.write_text("".join(f'#include "{one}"\n' for one in sources))
    run_compiler("-O1", "-shared", "-Wl,-z,lazy", "-o", str(path), str(unit))
    return path


@pytest.fixture(scope="session")
def cpp_core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the compiled core."""
    require("g++")
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cpp_core"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:  # the first worker compiles for all
        fcntl.flock(lock, fcntl.LOCK_EX)
        return library_in(folder)


@cache
def loaded(path: Path) -> ctypes.CDLL:
    """Return the library, with the libsodium that PyNaCl contains."""
    spec = importlib.util.find_spec("nacl._sodium")
    assert spec is not None
    assert spec.origin is not None
    ctypes.CDLL(spec.origin, ctypes.RTLD_GLOBAL)
    library = ctypes.CDLL(str(path), os.RTLD_LAZY)
    if hasattr(library, "contract_run"):
        library.contract_run.restype = library.contract_names.restype = ctypes.c_char_p
        return library
    for name in ("node_new", "buffer_new", "cuts_new"):
        getattr(library, name).restype = ctypes.c_void_p
    for name in ("bridge_error", "cuts_take", "cuts_missing", "snapshot_newest"):
        getattr(library, name).restype = ctypes.c_char_p
    library.node_sequence.restype = ctypes.c_uint64
    for name in ("node_buffered", "cuts_stored"):
        getattr(library, name).restype = ctypes.c_size_t
    return library


_INT, _I64, _F64, _TEXT = ctypes.c_int, ctypes.c_int64, ctypes.c_double, ctypes.c_char_p
_BYTES, _SIZE = ctypes.POINTER(ctypes.c_uint8), ctypes.c_size_t
#: Functions that the core calls, in the order of `Calls` in bridge.cpp: result, then arguments.
SIGNATURES: Final[dict[str, tuple[Any, ...]]] = {
    "now": (_F64,),
    "wake_in": (None, _F64),
    "log": (None, _INT, _TEXT),
    "open_writer": (_INT, _TEXT, _INT),
    "open_reader": (_INT, _TEXT, _INT),
    "close": (None, _INT),
    "publish": (None, _INT, _BYTES, _SIZE),
    "take": (_INT, _INT),
    "matched": (_INT, _INT, _INT),
    "acknowledged": (_INT, _INT),
    "due": (_I64, _INT),
    "follows_ros_time": (_INT, _INT),
    "start_in": (None, _INT, _I64),
    "stop": (None, _INT),
    "open": (_INT, _INT),
    "close_opening": (_INT, _INT),
    "serve_held": (_INT, _INT),
    "take_waiting": (None, _INT),
    "size_of": (_I64, _I64),
    "serve": (_INT, _I64),
    "drop": (None, _I64),
    "save": (_INT, _INT),
    "restore": (_INT, _INT, _BYTES, _SIZE),
}


class Calls(ctypes.Structure):
    """Functions of a test that the core calls."""

    _fields_ = [(name, ctypes.CFUNCTYPE(*types)) for name, types in SIGNATURES.items()]


def calls_of(functions: dict[str, Callable[..., Any]]) -> Calls:
    """Return the structure of functions that are given by their names."""
    return Calls(
        **{name: ctypes.CFUNCTYPE(*SIGNATURES[name])(functions[name]) for name in SIGNATURES}
    )
