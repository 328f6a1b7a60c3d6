"""`setup.py` of every ROS package in this folder: `colcon build` runs it by a symbolic link.

A package has `package.xml`, its marker in `resource/`, and a link to the Python package. Its name
and entry points are those of the `pyproject.toml` beside that package.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from setuptools import find_packages, setup

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# With `colcon build --symlink-install` the working directory has links to the files of the package.
here = Path("package.xml").resolve().parent
(top,) = [one for one in here.iterdir() if one.is_symlink() and one.is_dir()]
project = tomllib.loads((top.resolve().parent / "pyproject.toml").read_text("utf-8"))["project"]
points = {"console_scripts": project.get("scripts", {}), **project.get("entry-points", {})}
installed = {
    "share/ament_index/resource_index/packages": "resource/*", f"share/{here.name}": "package.xml",
    f"share/{here.name}/launch": "launch/*", f"lib/{here.name}": "scripts/*",
}  # fmt: skip
files = {to: sorted(map(str, here.glob(pattern))) for to, pattern in installed.items()}

setup(
    name=project["name"],
    version=re.search("<version>(.+)</version>", (here / "package.xml").read_text("utf-8"))[1],
    packages=find_packages(include=[top.name, f"{top.name}.*"]),
    package_data={top.name: ["**/*"]},
    exclude_package_data={top.name: ["__pycache__/*", "**/__pycache__/*"]},
    data_files=[
        (to, [os.path.relpath(one, here) for one in found]) for to, found in files.items() if found
    ],
    entry_points={
        group: [f"{name} = {target}" for name, target in found.items()]
        for group, found in points.items()
    },
    zip_safe=False,
)
