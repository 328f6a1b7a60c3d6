"""Every error that rosrm raises on purpose.

RosrmError                  what a user reads: no traceback is shown for it
├── ConfigError             a file or option that cannot be accepted: where, what, what is allowed
├── PluginError             a plugin that does not import, raises, or answers nonsense
├── Refused                 a request that was understood and turned down
├── NoMaster                no master answered in time
├── LaunchError             a process that cannot be started on this host
├── JournalError            the durable record cannot be read or written
│   └── JournalBlocked      not just now: it may pass by itself
├── RecordError             the record of a master's run cannot be read
├── SupervisorError         the supervisor cannot be started or reached
├── TransferError           a directory cannot be moved to another host
├── LabError                a virtual host or its network cannot be made, or is not there
├── PortableError           a node that cannot leave the ROS graph, or join it again, and why
└── CriuError               there is no CRIU that works here, or it could not dump or restore

SkipPlugin                  not an error: a plugin says that it is absent here, and why
"""

from __future__ import annotations


class RosrmError(Exception):
    """Something that a user can understand and mend; its text is the whole message."""

    exit_code = 1


class ConfigError(RosrmError):
    """A file or an option that cannot be accepted; nothing of it was used."""

    exit_code = 2


class PluginError(RosrmError):
    """A plugin that does not import, raises, hangs or answers nonsense."""


class Refused(RosrmError):
    """A request that was understood and turned down; nothing was changed.

    Args:
        message: what, where, what is allowed.
        code: the reason in one word, as in `rosrm_msgs/Answer`.
    """

    def __init__(self, message: str, code: str = "invalid") -> None:
        super().__init__(message)
        self.code = code


class NoMaster(RosrmError):
    """No master answered in time."""

    exit_code = 3


class LaunchError(RosrmError):
    """A process that cannot be started on this host, and why."""


class JournalError(RosrmError):
    """The durable record cannot be read or written."""


class JournalBlocked(JournalError):
    """The durable record cannot be written just now; nothing was changed, it may be tried again."""


class RecordError(RosrmError):
    """The record of a master's run is none, damaged, cut short, or of another version."""

    exit_code = 2


class SupervisorError(RosrmError):
    """The supervisor of this host cannot be started or reached."""


class TransferError(RosrmError):
    """A directory cannot be offered to another host, or fetched from one; nothing is left of it."""


class LabError(RosrmError):
    """A virtual host or its network cannot be made, changed or found."""


class CriuError(RosrmError):
    """There is no CRIU that works here, or it could not dump or restore, and why."""


class PortableError(RosrmError):
    """A node that cannot be asked to leave the ROS graph or to join it again, or does not do it."""


class SkipPlugin(Exception):
    """Raised by a plugin's `create` to say that it is absent on this host, and why."""
