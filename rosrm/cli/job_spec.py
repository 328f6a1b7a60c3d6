"""Spec of the job of `rosrm run`, from the words of the command line."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rosrm.client.connecting import check_name
from rosrm.config.checking import near
from rosrm.config.documents import Node, Place, node_of
from rosrm.config.work import checked_work
from rosrm.errors import ConfigError, Refused
from rosrm.extensions.registry import Registry
from rosrm.model.rows import HostRow
from rosrm.model.values import ProcessSpec


def job_of(
    command: Sequence[str], *, name: str = "", needs: Mapping[str, str],
    environment: Mapping[str, str], time_limit: str = "", directory: str = "",
) -> ProcessSpec:  # fmt: skip
    """Return the spec of a job from the words of the command line; raises `ConfigError`.

    The rules of a work file apply; a message names the option instead of a line.
    """
    if not command:
        raise ConfigError("run: no command is given; write it after --: rosrm run -- COMMAND ARG")
    fields: dict[str, Node] = {
        "name": node_of(name or _name_of(command[0]), Place("--name", 0, 0)),
        "kind": node_of("job", Place("run", 0, 0)),
        "command": node_of(list(command), Place("COMMAND", 0, 0)),
        "needs": node_of(needs, Place("--needs", 0, 0)),
        "environment": node_of(environment, Place("--env", 0, 0)),
    }
    if time_limit:
        fields["time_limit"] = node_of(time_limit, Place("--time-limit", 0, 0))
    if directory:
        fields["working_directory"] = node_of(directory, Place("--working-directory", 0, 0))
    place = Place("run", 0, 0)
    process = Node(fields, place, place)
    work = Node({"processes": Node((process,), place, place)}, place)
    return checked_work(work, "run", registry=None).specs[0]


def _name_of(program: str) -> str:
    """Return the stem of a program's file with a random suffix, as a name that rosrm allows."""
    stem = "".join(
        one if one.isascii() and (one.isalnum() or one in "_-.") else "_"
        for one in Path(program).stem
    )
    return f"{stem.lstrip('-.')[:100] or 'job'}-{secrets.token_hex(2)}"


def placed(spec: ProcessSpec, on: Sequence[str], hosts: Sequence[HostRow]) -> ProcessSpec:
    """Return the spec with the labels that `--on` requires.

    Args:
        on: names of hosts, or LABEL=VALUE.
        hosts: of the cluster.

    Raises:
        ConfigError: a need or a label that no host has.
        Refused: an unknown host, or one that no label distinguishes from the others.
    """
    _check_needs(spec, hosts)
    required: dict[str, str] = {}
    for word in on:
        key, mark, value = word.partition("=")
        chosen = {key: value} if mark else _label_of(word, hosts)
        if mark and not any(row.description.labels.get(key) == value for row in hosts):
            known = sorted({f"{k}={v}" for row in hosts for k, v in row.description.labels.items()})
            raise ConfigError(f"--on {word}: no host has this label{near(word, known)}")
        required.update(chosen)
    return replace(spec, required_labels=required)


def _check_needs(spec: ProcessSpec, hosts: Sequence[HostRow]) -> None:
    """Refuse a resource that neither a host nor an installed probe measures."""
    measured = {resource.name for row in hosts for resource in row.resources}
    unknown = [name for name in spec.needs if name not in measured]
    if unknown:
        known = sorted(measured.union(Registry.discover().resources()))
        for name in unknown:
            if name not in known:
                raise ConfigError(f"--needs {name}: no probe reads {name!r}{near(name, known)}")


def _label_of(name: str, hosts: Sequence[HostRow]) -> Mapping[str, str]:
    """Return a label that one host has, and no other."""
    check_name("host", name, [row.description.name for row in hosts])
    labels = {row.description.name: row.description.labels for row in hosts}
    others = [item for host, given in labels.items() if host != name for item in given.items()]
    own = [item for item in labels[name].items() if item not in others]
    if not own:
        raise Refused(
            f"--on {name}: the host has no label of its own, by which a job could require it. "
            f"Give it one in its host.yaml, for example `labels: {{host: {name}}}`"
        )
    return dict(sorted(own, key=lambda item: item[1] != name)[:1])
