# SPDX-License-Identifier: BSD-3-Clause
"""The directive `command-help`: what `vprism-plan COMMAND --help` prints, word for word."""

import contextlib
import io
import os
import re

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

_COLUMNS = "96"
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


class CommandHelp(Directive):
    """Takes the name of a command, or nothing for the list of all."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the help as a literal block."""
        text = help_of(*self.arguments)
        return [nodes.literal_block(text, text, language="text")]


def help_of(*command: str) -> str:
    """Return the help of a command as plain text."""
    from vprism_plan.cli._parsing import parse

    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _COLUMNS
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            parse([*command, "--help"])
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    return "\n".join(line.rstrip() for line in _COLOURS.sub("", said.getvalue()).splitlines())


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("command-help", CommandHelp)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
