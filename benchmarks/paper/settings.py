"""Settings of the paper, and the numbers of its figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from rosrm_lab import MIB, HostPlan

#: Section IV A: only memory counts, up to 80 % of it, at 10 Hz.
WEIGHTS: Final = {"memory": 1.0, "cpu": 0.0, "disk": 0.0}
MEMORY_LIMIT: Final = 0.8
RATE_HZ: Final = 10.0

#: Fig. 9: y = 0.0843 x + 0.0173, milliseconds by slaves.
FIG9_SLOPE_MS: Final = 0.0843
FIG9_INTERCEPT_MS: Final = 0.0173

#: Table III, minutes.
TABLE3_MIN: Final = {"one_host": 109.5, "ideal": 2.5, "rosrm": 3.6}

#: MB of a holder's own footprint, because it is a Python process: of its anonymous memory, rounded
#: down, because the part of a need that is not used stays reserved.
HOLDER_MB: Final = 6.0


def cluster_settings(**sections: Any) -> dict[str, Any]:
    """Return a `cluster.yaml` with the paper's settings.

    Args:
        sections: further sections of the file.
    """
    scoring = {"policy": "weighted", "options": {"weights": WEIGHTS}}
    return {"name": "paper", "scoring": scoring, **sections}


def host_settings(name: str, **sections: Any) -> dict[str, Any]:
    """Return a `host.yaml` with the paper's settings: CPU and disk have no limit.

    Args:
        name: of the host.
        sections: further sections of the file.
    """
    limits = {"memory": MEMORY_LIMIT, "cpu": 1.0, "disk": 1.0}
    return {"host": name, "rate": RATE_HZ, "limits": limits, **sections}


def holder(name: str, mb: float, **entries: Any) -> dict[str, Any]:
    """Return an entry of a `work.yaml`: a plain process that holds memory until it is stopped.

    Args:
        name: of the process.
        mb: that it holds (1 MB = 10^6 bytes), in addition to its own footprint.
        entries: further fields of the entry.
    """
    return {
        "name": name,
        "module": "rosrm_examples.holder",
        "arguments": ["--mb", f"{mb:g}"],
        "needs": {"memory": f"{mb + HOLDER_MB:g}MB", "cpu": 0},
        **entries,
    }


def alike(plans: Sequence[HostPlan]) -> str:
    """Return number and size of equal hosts, as text."""
    memory, cpu = (plans[0].memory or 0) / MIB, plans[0].cpu or 0.0
    return f"{len(plans)} of {memory:g} MiB and {cpu:g} cores each on one machine"
