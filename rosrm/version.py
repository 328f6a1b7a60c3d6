"""The version of the software, and that of what travels between its parts."""

from typing import Final

__version__: Final = "0.1.0"

#: Grows with every change of `rosrm_msgs` or of its meaning; peers of other versions are refused.
PROTOCOL_VERSION: Final = 6
