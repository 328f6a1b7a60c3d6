"""The processes of a launch file, as the resolver prints them in JSON."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

#: A plain command, a node, a lifecycle node, or a container of components.
ProcessKind = Literal["command", "node", "lifecycle", "container"]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Parameters(_Part):
    """ROS parameters of the nodes that fit a pattern; values as in JSON, by dotted names."""

    nodes: str = "/**"
    values: dict[str, Any]


class Wait(_Part):
    """Event of another process, after which a process starts.

    Attributes:
        process: number of the other process.
    """

    process: int
    event: Literal["started", "exited"]


class Component(_Part):
    """Component that a container loads; parameters as in `Parameters.values`.

    Attributes:
        sections: full names of all nodes in its parameter files.
    """

    package: str
    plugin: str
    name: str = ""
    namespace: str = ""
    parameters: dict[str, Any] = {}
    remappings: list[tuple[str, str]] = []
    arguments: dict[str, Any] = {}
    sections: list[str] = []


class Process(_Part):
    """One process of the launch file.

    Attributes:
        number: its place in the list of processes.
        file: launch file that has its action.
        name: name of its node; "": the node keeps its own.
        package: ROS package of `executable`; "": `command` is given.
        command: program and its words, without prefix; one text with `shell`.
        environment: variables that differ from those of the resolver.
        respawn_retries: -1: without end.
        interrupt_grace, terminate_grace: seconds from SIGINT to SIGTERM, and to SIGKILL.
        waits: events after which it starts.
        delay: seconds after these events, or after the start of the launch file.
        ends_all: its end shuts the launch file down.
        paths: absolute paths in its texts that exist where the file was resolved.
    """

    number: int
    kind: ProcessKind
    file: str
    name: str = ""
    label: str = ""
    namespace: str = ""
    package: str = ""
    executable: str = ""
    command: list[str] = []
    shell: bool = False
    prefix: list[str] = []
    arguments: list[str] = []
    parameters: list[Parameters] = []
    remappings: list[tuple[str, str]] = []
    environment: dict[str, str] = {}
    working_directory: str = ""
    respawn: bool = False
    respawn_delay: float = 0.0
    respawn_retries: int = -1
    interrupt_grace: float = 5.0
    terminate_grace: float = 5.0
    waits: list[Wait] = []
    delay: float = 0.0
    ends_all: bool = False
    components: list[Component] = []
    paths: list[str] = []


class Load(_Part):
    """Components that are loaded into a container by its name."""

    file: str
    container: str
    components: list[Component]


class Transition(_Part):
    """Change of the state of lifecycle nodes."""

    file: str
    nodes: list[str]
    transition: str


class Omission(_Part):
    """Action of a launch file that has no counterpart in rosrm."""

    file: str
    action: str
    reason: str

    def __str__(self) -> str:
        return f"{self.file}: {self.action}: {self.reason}"


class Argument(_Part):
    """Argument that a launch file declares; `default` None: it must be given."""

    name: str
    default: str | None = None
    description: str = ""
    choices: list[str] = []


class LaunchModel(_Part):
    """All that a launch file starts, and what could not be resolved.

    Attributes:
        file: path of the launch file.
        packages: name of each package whose directory occurs in a text, to its install prefix.
        notes: facts that a user should know, such as commands that were run while resolving.
    """

    file: str
    arguments: list[Argument] = []
    processes: list[Process] = []
    loads: list[Load] = []
    transitions: list[Transition] = []
    omissions: list[Omission] = []
    packages: dict[str, str] = {}
    notes: list[str] = []


class Failure(_Part):
    """Reason why a launch file could not be resolved; the resolver prints it instead of a model."""

    failure: str
