"""Words of a command that name files relative to the working directory of the process."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Final

from rosrm.model.values import ProcessSpec

#: Most words of one command that are looked up.
MOST: Final = 8
#: Endings of files that programs read, rather than write.
_READ: Final = frozenset({
    ".bash", ".cfg", ".conf", ".db3", ".ini", ".jar", ".js", ".json", ".launch", ".lua", ".mcap",
    ".onnx", ".pcd", ".pgm", ".pl", ".py", ".rb", ".rviz", ".sdf", ".sh", ".toml", ".urdf",
    ".xacro", ".xml", ".yaml", ".yml", ".zsh",
})  # fmt: skip
#: Programs whose first argument is the path of a script.
_INTERPRETERS: Final = ("bash", "dash", "lua", "node", "perl", "python", "ruby", "sh", "zsh")


def relative_files(spec: ProcessSpec) -> tuple[str, ...]:
    """Return the words of a command that name relative files to read, at most `MOST`.

    Such a word begins with `./` or `../`, or has the ending of a file that programs read, or is the
    script of an interpreter. Other words may be outputs or no files. A program in an image has no
    working directory on the host, so the result is empty.
    """
    if spec.container.image:
        return ()
    found = [word for word in _words(spec) if _names_a_file(word)]
    return tuple(dict.fromkeys([*_script(spec), *found]))[:MOST]


def _words(spec: ProcessSpec) -> list[str]:
    """Return the arguments of the program itself; of an option with a value, the value."""
    words = [*spec.command[1:], *spec.arguments]
    if "--ros-args" in words:
        del words[words.index("--ros-args") :]
    return [word.partition("=")[2] if word.startswith("-") else word for word in words]


def _names_a_file(word: str) -> bool:
    if word.startswith(("./", "../")):
        return True
    path = PurePosixPath(word)
    is_one = path.suffix in _READ and not path.is_absolute() and not word.startswith("~")
    return is_one and not any(mark in word for mark in ("://", ":=", " ", "\n", "{", "*"))


def _script(spec: ProcessSpec) -> tuple[str, ...]:
    """Return the script that an interpreter of the command runs, if it is a relative path."""
    program, *words = spec.command or ("",)
    script = words[0] if words else ""
    is_path = "/" in script and not script.startswith(("/", "~", "-"))
    runs = PurePosixPath(program).name.rstrip("0123456789.") in _INTERPRETERS
    return (script,) if runs and is_path else ()
