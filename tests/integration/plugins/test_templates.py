"""The templates of `rosrm plugin new` come with the distribution."""

from __future__ import annotations

import zipfile

from tests.pip_environments import ROOT


def test_the_wheel_of_rosrm_has_every_file_of_the_templates(environment):
    """A user's pip builds the wheel from the sources, without downloads."""
    built = environment.shell(
        f"python -m pip wheel --quiet --no-deps --no-build-isolation --no-index -w wheels {ROOT}"
    )
    assert built.returncode == 0, built.stderr
    (wheel,) = (environment.folder / "wheels").glob("rosrm-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    folder = ROOT / "rosrm" / "cli" / "templates"
    files = [path for path in folder.rglob("*") if path.suffix in (".py", ".toml", ".yaml")]
    assert len(files) > 10
    assert {str(path.relative_to(ROOT)) for path in files} <= names
