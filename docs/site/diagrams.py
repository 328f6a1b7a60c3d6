"""The directive `mermaid`: a diagram drawn at build time, so that a page loads no script for it."""

from __future__ import annotations

import base64
from html import escape
from typing import Any

import mmdr
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Mermaid(SphinxDirective):
    """Draw a fenced `mermaid` block as an SVG picture; its source is the alternative text."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the picture."""
        source = "\n".join(self.content)
        try:
            drawn = mmdr.render(source).svg()
        except Exception as fault:  # noqa: BLE001 - the classes of its errors are not documented
            raise self.error(f"this diagram cannot be drawn: {fault}") from None
        data = base64.b64encode(drawn.encode()).decode()
        picture = f'<img src="data:image/svg+xml;base64,{data}" alt="{escape(source)}">'
        return [nodes.raw("", f'<p class="diagram">{picture}</p>', format="html")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("mermaid", Mermaid)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
