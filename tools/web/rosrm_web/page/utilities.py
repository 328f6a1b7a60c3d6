"""CSS of the utility classes that the page uses.

They have the names and values of Tailwind, which is not loaded: its 260 kB of JavaScript would look
at each new element. A new class needs a rule here.
"""

from __future__ import annotations

from typing import Final

UTILITIES: Final = """
.w-full { width: 100%; }
.w-32 { width: 8rem; }
.max-w-full { max-width: 100%; }
.max-w-screen-lg { max-width: 64rem; }
.h-96 { height: 24rem; }
.p-0 { padding: 0; }
.px-2 { padding-left: 0.5rem; padding-right: 0.5rem; }
.gap-1 { gap: 0.25rem; }
.gap-2 { gap: 0.5rem; }
.gap-x-3 { column-gap: 0.75rem; }
.gap-y-1 { row-gap: 0.25rem; }
.items-center { align-items: center; }
.whitespace-pre-line { white-space: pre-line; }
.sr-only {
  position: absolute; width: 1px; height: 1px; margin: -1px; padding: 0; overflow: hidden;
  clip-path: inset(50%); white-space: nowrap; border-width: 0;
}
"""
