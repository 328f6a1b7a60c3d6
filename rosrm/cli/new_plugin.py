"""Creation of the package of a new plugin from a template of its kind.

A template is a working package with the name `example`, in `templates/KIND/`. The new package has
its own name in the place of that one.
"""

from __future__ import annotations

import os
import re
import tempfile
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Final, cast

from rosrm.config.options import DEFAULT_PROBES
from rosrm.errors import ConfigError
from rosrm.extensions.plugin_calls import TITLES
from rosrm.extensions.registry import Registry
from rosrm.model.rows import PluginKind
from rosrm.wording import reason_of

#: One folder for each kind of plugin, and what they share.
TEMPLATES: Final = Path(__file__).parent / "templates"
_NAME: Final = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")
_LONGEST: Final = 50


def create_package(kind: str, name: str, into: Path, registry: Registry) -> Path:
    """Write the package `rosrm-NAME` of a new plugin, and return its folder.

    Args:
        kind: name of a folder in `TEMPLATES`.
        name: name of the plugin in configuration files.
        into: folder of the package's folder; created if it does not exist.
        registry: the installed plugins, whose names are taken.

    Raises:
        ConfigError: the name cannot be used, the folder exists, or it cannot be written.
    """
    fault = _fault_of(cast(PluginKind, kind), name, registry)
    if fault:
        raise ConfigError(fault)
    folder = into / f"rosrm-{name}"
    if os.path.lexists(folder):
        raise ConfigError(f"{folder} exists already: choose another name, or another --into")
    try:
        into.mkdir(parents=True, exist_ok=True)
        # Renamed when complete, because a partial package would be refused the next time.
        with tempfile.TemporaryDirectory(prefix=f".rosrm-{name}-", dir=into) as temporary:
            package = Path(temporary) / "package"
            _write(kind, name, package)
            package.rename(folder)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {reason_of(error)}") from None
    return folder


def _write(kind: str, name: str, package: Path) -> None:
    package.mkdir()
    files = [path for path in (TEMPLATES / kind).iterdir() if path.is_file()]
    for path in (TEMPLATES / "pyproject.toml", *files):
        text = _renamed(path.read_text(encoding="utf-8"), name)
        (package / _renamed(path.name, name)).write_text(text, encoding="utf-8")


def _renamed(text: str, name: str) -> str:
    words = name.replace("-", "_")
    camel = "".join(word.capitalize() for word in words.split("_"))
    text = text.replace("rosrm_example", f"rosrm_{words}")
    return text.replace("Example", camel).replace("example", name)


def _fault_of(kind: PluginKind, name: str, registry: Registry) -> str:
    """Return why a new plugin cannot have a name; "": it can."""
    if not _NAME.fullmatch(name) or len(name) > _LONGEST:
        return (
            f"{name!r:.250} cannot be the name of a plugin. Allowed: at most {_LONGEST} lower-case "
            "letters and digits, the first a letter, with single '-' or '_' between them"
        )
    taken = (*registry.names(kind), *(registry.resources() if kind == "probe" else ()))
    if name in taken or (kind == "probe" and name == DEFAULT_PROBES):
        return f"there is a {TITLES[kind]} {name!r} already; see `rosrm plugins --local`"
    if _is_installed(name):
        return f"a distribution rosrm-{name} is installed already: choose another name"
    return ""


def _is_installed(name: str) -> bool:
    """Return True if a package of this name would replace another one."""
    if find_spec(f"rosrm_{name.replace('-', '_')}") is not None:
        return True
    try:
        version(f"rosrm-{name}")
    except PackageNotFoundError:
        return False
    return True
