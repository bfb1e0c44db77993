# SPDX-License-Identifier: BSD-3-Clause
"""Docstrings are written for readers of the code; here they become reStructuredText."""

import re
from typing import Any

from sphinx.application import Sphinx

# |x|, *args and trailing underscores mean themselves.
_MARKUP = re.compile(r"(?<![\\`\w*])([*|])(?=\w)|(?<=\w)([*|_])(?![\w`*])")
_ITEM = re.compile(r"\s*([-*]|\d+\.)\s")


def setup(app: Sphinx) -> dict[str, bool]:
    """Run before napoleon, which reads the sections."""
    app.connect("autodoc-process-docstring", process, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def process(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Change the lines of a docstring into markup, in place."""
    # A heading over indented entries is a section, with or without its colon.
    for i, line in enumerate(lines[:-1]):
        if re.fullmatch(r"[A-Z][a-z ]+", line) and re.match(r"    \w+(, \w+)*: ", lines[i + 1]):
            lines[i] = f"{line}:"
    lines[:] = _escaped("\n".join(_spaced(lines))).split("\n")


def _spaced(lines: list[str]) -> list[str]:
    """Put blank lines around what is indented, outside of the sections that napoleon reads."""
    out: list[str] = []
    section = False
    for line in lines:
        if line and not line.startswith(" "):
            section = bool(re.fullmatch(r"[A-Z][A-Za-z ]+:", line))
        before = out[-1] if out else ""
        text = line.strip() and before.strip() and not section
        listed = _ITEM.match(before) or _ITEM.match(line)
        if text and not listed and abs(_indent(line) - _indent(before)) >= 2:
            out.append("")
        out.append(line)
    return out


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _escaped(text: str) -> str:
    pieces = re.split(r"(``[^`]+``|:\w+:`[^`]+`|`[^`]+`)", text)
    for i, piece in enumerate(pieces):
        if piece.startswith("`") and not piece.startswith("``"):
            # Inline code must end before what is no word: an empty escape separates them.
            plural = "\\ " if re.match(r"\w", pieces[i + 1]) else ""
            pieces[i] = f"`{' '.join(piece.split())}`{plural}"
        elif not piece.startswith((":", "``")):
            pieces[i] = _MARKUP.sub(lambda hit: "\\" + hit[0], piece)
    return "".join(pieces)
