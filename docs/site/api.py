"""The API reference: the directive `public-names`, and links between types.

The docstring of `rosrm` lists the public names by purpose, so no page repeats the list.
"""

from __future__ import annotations

import inspect
import re
from typing import Any, Final

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

import rosrm

_ROW: Final = re.compile(r"^ *([A-Z][a-z]+|[a-z][a-z ]+?) {2,}(\S.*(?:\n {16}.*)*)", re.MULTILINE)


def names_by_purpose() -> dict[str, list[str]]:
    """Return the public names of `rosrm` for each purpose that its docstring lists."""
    _, _, table = (rosrm.__doc__ or "").partition("The public names, by purpose:\n")
    return {
        purpose: [name for name in re.findall(r"\w+", row) if name in rosrm.__all__]
        for purpose, row in _ROW.findall(table.partition("\n\nAll units")[0])
    }


class PublicNames(SphinxDirective):
    """Describe the public names of some purposes, one purpose a line."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the descriptions."""
        names = (name for purpose in self.content for name in names_by_purpose()[purpose])
        text = "\n\n".join([".. py:currentmodule:: rosrm", *map(_description, names)])
        return self.parse_text_to_nodes(f"```{{eval-rst}}\n{text}\n```")


def _description(name: str) -> str:
    """Return the directive that describes a public name."""
    value = getattr(rosrm, name)
    if inspect.isclass(value) and issubclass(value, Exception):
        return f".. autoexception:: {name}\n   :show-inheritance:"
    if inspect.isclass(value):
        return f".. autoclass:: {name}"
    if inspect.isfunction(value):
        return f".. autofunction:: {name}"
    # A type or an object has no docstring of its own, but a comment where it is defined.
    module = f"rosrm.{rosrm._MODULES[name]}"  # noqa: SLF001 - where a name is defined
    comments = ModuleAnalyzer.for_module(module).find_attr_docs()
    return "\n   ".join([f".. py:data:: {name}", "", *comments["", name]])


def _keep_colon(
    app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Put an empty comment first, because napoleon takes words before a colon for a type there."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]


def _show_defaults(
    app: Sphinx, what: str, name: str, value: object, options: object, *shown: str | None
) -> tuple[str | None, ...]:
    """Replace default values that are no Python (`<factory>`), so that Sphinx reads the types."""
    return tuple(text and re.sub(r"<[^<>]+>", "...", text) for text in shown)


def _public(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.reference | None:
    """Resolve the private place of a public name, as annotations have it, to its public one."""
    name = str(node.get("reftarget", "")).rpartition(".")[2]
    if node.get("refdomain") != "py" or name not in rosrm.__all__:
        return None
    domain = env.domains["py"]
    for kind in ("class", "exc", "data"):
        found = domain.resolve_xref(
            env, node["refdoc"], app.builder, kind, f"rosrm.{name}", node, content
        )
        if found is not None:
            return found
    return None


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive and the links."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", _keep_colon, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", _show_defaults)
    app.connect("missing-reference", _public)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
