"""Units of systemd that run a master or a slave: their text, and the variables that they need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

from rosrm.errors import ConfigError
from rosrm.runtime import cgroups, oom_score

Part = Literal["master", "slave"]

#: First words of every unit that rosrm writes; no other unit is overwritten or removed.
MARK: Final = "# Written by `rosrm service install"
#: Variables that a shell sets up and systemd does not: where ROS and rosrm find things.
_VARIABLES: Final = frozenset({
    "AMENT_PREFIX_PATH", "LD_LIBRARY_PATH", "PATH", "PYTHONPATH",
    "ROSRM_CLUSTER", "ROSRM_CRIU", "ROSRM_CRIU_PREFIX", "ROSRM_INTERFACE", "ROSRM_KEY",
    "ROSRM_KEYS", "ROSRM_SCOPE", "ROSRM_SECURITY",
    "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME",
})  # fmt: skip
_PREFIXES: Final = (
    "CYCLONEDDS_", "FASTDDS_", "FASTRTPS_", "RCL_", "RCUTILS_", "RMW_", "ROS_", "ZENOH_",
)  # fmt: skip
_ESCAPED: Final = str.maketrans({"\\": r"\\", '"': r"\"", "%": "%%"})

#: The processes of a slave inherit what systemd restricts, so nothing is restricted here.
_SLAVE: Final = f"""\
# The supervisor and the processes survive a restart of the slave (`on_stop: keep`).
KillMode=process
# The slave stops and kills its processes itself, as their `stop` says.
TimeoutStopSec=11min
# For limits of processes; DelegateSubgroup needs systemd 254.
Delegate=yes
DelegateSubgroup={cgroups.AGENTS}
OOMPolicy=continue
TasksMax=infinity
"""
#: Rights that only the manager of the machine can give.
_SLAVE_OF_THE_MACHINE: Final = f"""\
LimitRTPRIO=50
LimitNICE=-10
# Slave and supervisor only: processes start with 0.
OOMScoreAdjust={oom_score.PROTECTED}
"""
_MASTER: Final = """\
NoNewPrivileges=yes
LockPersonality=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
"""
#: These need namespaces, which the manager of a user may be refused.
_MASTER_OF_THE_MACHINE: Final = """\
ProtectSystem=full
ProtectControlGroups=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
"""


def unit_name(part: Part) -> str:
    """Return the name of the unit's file."""
    return f"rosrm-{part}.service"


def needed_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables of a shell that a master or slave needs under systemd, by name."""
    return {
        name: value
        for name, value in sorted(environment.items())
        if name in _VARIABLES or name.startswith(_PREFIXES)
    }


def unit_text(
    part: Part, command: Sequence[str], variables: Mapping[str, str], user: str | None
) -> str:
    """Return the text of a unit.

    Args:
        part: the part of rosrm that the unit runs.
        command: command line of the part; its first word is an absolute path.
        variables: environment of the part and of its processes.
        user: user that runs the part; None: a unit of the manager of one user.

    Raises:
        ConfigError: a word or a variable has a control character.
    """
    after = "" if user is None else "Wants=network-online.target\nAfter=network-online.target\n"
    # A `$` begins a variable in arguments, but neither in the path nor in Environment.
    arguments = [_quoted(word).replace("$", "$$") for word in command[1:]]
    lines = [
        *([] if user is None else [f"User={user}"]),
        *(f"Environment={_quoted(f'{name}={value}')}" for name, value in variables.items()),
        f"ExecStart={' '.join([_quoted(command[0]), *arguments])}",
    ]
    settings = {
        ("slave", True): _SLAVE, ("slave", False): _SLAVE + _SLAVE_OF_THE_MACHINE,
        ("master", True): _MASTER, ("master", False): _MASTER + _MASTER_OF_THE_MACHINE,
    }[part, user is None]  # fmt: skip
    return f"""\
{MARK} {part}`. `systemctl edit` adds settings of your own.
[Unit]
Description=rosrm {part}
{after}StartLimitIntervalSec=0

[Service]
Type=exec
{chr(10).join(lines)}
ExecReload=/bin/kill -HUP $MAINPID
Restart=always
RestartSec=2
{settings}
[Install]
WantedBy={wanted_by(user is None)}
"""


def wanted_by(of_user: bool) -> str:
    """Return the target that starts an enabled unit: of the manager of a user, or the machine's."""
    return "default.target" if of_user else "multi-user.target"


def _quoted(word: str) -> str:
    if not word.isprintable():
        raise ConfigError(f"a unit of systemd cannot have the control characters of {word!r}")
    return f'"{word.translate(_ESCAPED)}"'
