"""Texts that name the keys of instances and handoffs in sealed messages."""

from __future__ import annotations


def instance_name(process: str, number: int) -> str:
    """Return the text that names the key of an instance."""
    return f"instance:{process}#{number}"


def named_instance(name: str) -> tuple[str, int] | None:
    """Return process and number from the name of an instance; None for any other text."""
    kind, _, instance = name.partition(":")
    process, _, number = instance.rpartition("#")
    if kind != "instance" or not (process and number.isascii() and number.isdecimal()):
        return None
    return process, int(number)


def handoff_name(process: str, destination: int) -> str:
    """Return the text that names the key of a handoff."""
    return f"handoff:{process}#{destination}"
