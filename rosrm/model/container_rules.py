"""Rules for the container of a process, checked at every boundary."""

from __future__ import annotations

from rosrm.model.values import ProcessSpec


def container_fault(spec: ProcessSpec) -> str:
    """Return the fault of the container of a process; "": none."""
    image, engine = spec.container.image, spec.container.engine
    if bool(image) != bool(engine):
        given, missing = ("image", "engine") if image else ("engine", "image")
        return f"container.{given} is given without container.{missing}"
    for name, word in (("image", image), ("engine", engine)):
        if word.startswith("-") or not word.isprintable() or " " in word:
            return f"container.{name} {word!r:.250}: a name is required, such as ros:jazzy"
    return ""
