"""Start time of the command's process, and its exit code after Ctrl-C."""

from __future__ import annotations

import errno
from typing import Final

from rosrm import clocks

#: Monotonic start time of this process, from which the time-outs of a command count.
BEGUN: Final = clocks.boot_time()

#: Errors of a file, such as the output, that takes no more data: a full disk, a quota, a limit of
#: the size of files, a disk that fails or is read-only.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)

#: Exit code of a program that Ctrl-C has ended, as in a shell.
INTERRUPTED: Final = 130
