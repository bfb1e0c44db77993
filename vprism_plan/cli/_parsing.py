# SPDX-License-Identifier: BSD-3-Clause
"""Arguments to a command, or one line that says what is wrong with them."""

import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence

from vprism_plan.cli._commands import Command, CommandLine

PROGRAM = "vprism-plan"
_DESCRIPTION = (
    "Plan robot motions around what one depth image shows and hides. Exit codes: 0 done, "
    "1 no safe answer, 2 bad input."
)
_FRAME = re.compile(r"^\s*[│|]\s?|\s*[│|]\s*$")


class UsageError(Exception):
    """The arguments cannot be used; the message is one line."""


def parse(arguments: Sequence[str]) -> Command:
    """Return the command; exits with 0 after `--help`.

    Raises:
        UsageError: what is wrong with the arguments.
    """
    import tyro

    if not arguments:
        raise UsageError(f"no command given; see {PROGRAM} --help")
    help_wanted = any(a in ("-h", "--help") for a in arguments)
    noise = io.StringIO()
    with contextlib.ExitStack() as stack:
        if not help_wanted:
            stack.enter_context(_wide_terminal())
            stack.enter_context(contextlib.redirect_stderr(noise))
        try:
            command: Command = tyro.cli(
                CommandLine,
                prog=PROGRAM,
                description=_DESCRIPTION,
                args=list(arguments),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
        except SystemExit as stop:
            if not stop.code:
                raise
            raise UsageError(_one_line(noise.getvalue())) from None
    return command


def _one_line(box: str) -> str:
    """Return the statement inside the box that the parser draws, without the hints below it."""
    said = []
    for line in box.splitlines():
        if "╭" in line or "╰" in line:
            continue
        text = _FRAME.sub("", line).strip()
        if set(text) == {"─"} or text.startswith("Got errors"):
            break
        said.append(text)
    text = " ".join(" ".join(said).split())
    text = re.sub(r"\[/?bold\]", "", text)
    return f"{text.rstrip('.')}; see {PROGRAM} --help"


@contextlib.contextmanager
def _wide_terminal() -> Iterator[None]:
    """Keep the parser from breaking its message into lines."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "2000"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
