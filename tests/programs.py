"""Programs of the machine that some tests need, with the packages that bring them."""

from __future__ import annotations

import shutil
from typing import Final

import pytest

#: Packages of Debian and Ubuntu whose program has another name.
_PACKAGES: Final = {
    "busybox": "busybox-static",
    "colcon": "python3-colcon-common-extensions",
    "mkfs.ext4": "e2fsprogs",
    "nft": "nftables",
    "promtool": "prometheus",
    "setcap": "libcap2-bin",
    "setpriv": "util-linux",
    "systemd-analyze": "systemd",
    "unshare": "util-linux",
}
#: Where a user without rights may find programs of the administrator, too.
_ADMINISTRATOR: Final = "/usr/sbin:/sbin"


def path_of(program: str) -> str | None:
    """Return the path of a program; None: it is not installed."""
    return shutil.which(program) or shutil.which(program, path=_ADMINISTRATOR)


def lack_of(*programs: str) -> str:
    """Return which of some programs are missing, and how to get them; "": none is."""
    missing = [one for one in programs if path_of(one) is None]
    packages = " ".join(sorted({_PACKAGES.get(one, one) for one in missing}))
    return f"not here: {', '.join(missing)} (apt-get install {packages})" if missing else ""


def require(*programs: str) -> None:
    """Skip the test if a program is missing."""
    if lack := lack_of(*programs):
        pytest.skip(lack)


def needs(*programs: str) -> pytest.MarkDecorator:
    """Return the mark of tests that are skipped if a program is missing."""
    lack = lack_of(*programs)
    return pytest.mark.skipif(bool(lack), reason=lack or "-")
