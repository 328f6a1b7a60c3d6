"""Errors of the examples that a user can meet.

ExampleError          one line that says what, where, and what is allowed
├── DriveError        a drive cannot be found, read or cut
└── PieceError        the pieces of a map cannot be joined
"""


class ExampleError(ValueError):
    """An argument or a file of the user cannot be used."""


class DriveError(ExampleError):
    """A drive cannot be found, read or cut."""


class PieceError(ExampleError):
    """The pieces of a map cannot be joined."""
