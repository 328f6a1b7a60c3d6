"""Versions of the software and of its protocol."""

from typing import Final

__version__: Final = "0.1.0"

#: Increased with every change of `rosrm_msgs` or its meaning; peers of other versions are refused.
PROTOCOL_VERSION: Final = 8
