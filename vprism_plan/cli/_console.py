# SPDX-License-Identifier: BSD-3-Clause
"""What a person sees while the work runs, and what it cost: progress on stderr, times kept."""

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan.errors import VPrismError

if TYPE_CHECKING:
    from rich.status import Status


class Console:
    """Shows the stage that runs (on a terminal), times it, and notices compilation.

    Attributes:
        timings: seconds per stage.
        compile_seconds: seconds spent compiling kernels; 0 once they are cached on disk.
        compiled: how many kernels that were.
        warnings: what is usable but odd about the input; part of every result.
    """

    def __init__(self, *, as_json: bool = False, strict: bool = False) -> None:
        self.as_json = as_json
        self.strict = strict
        self.warnings: list[str] = []
        self.timings: dict[str, float] = {}
        self.compile_seconds = 0.0
        self.compiled = 0
        self._status: Status | None = None
        self._stage = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block under `name` and show it while it runs."""
        began = time.perf_counter()
        self._stage = name
        with self._spinner(f"{name} ...") as status, self._watch_compiler():
            self._status = status
            try:
                yield
            finally:
                self._status = None
                self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - began

    def _spinner(self, text: str) -> Any:
        if not sys.stderr.isatty():
            return nullcontext(None)
        from rich.console import Console as RichConsole

        return RichConsole(stderr=True).status(text)

    @contextmanager
    def _watch_compiler(self) -> Iterator[None]:
        """Count what numba compiles (not what it loads from its cache) in this block."""
        from numba.core import event

        clock = _CompileClock(self)

        class Listener(event.Listener):
            def on_start(self, event: Any) -> None:
                clock.start(event)

            def on_end(self, event: Any) -> None:
                clock.end(event)

        with event.install_listener("numba:compile", Listener()):
            yield

    def compiling(self, kernel: str) -> None:
        """Say which kernel is being compiled."""
        if self._status is not None:
            self._status.update(
                f"{self._stage}: compiling {kernel} (on first use only, "
                f"{self.compile_seconds:.0f} s so far) ..."
            )

    def compile_note(self) -> str:
        """Return a phrase on compilation for the summary, empty if nothing was compiled."""
        if not self.compiled:
            return ""
        return (
            f"{self.compile_seconds:.1f} s of it compiled {self.compiled} kernels "
            "(first use; cached now)"
        )

    def warn(self, warnings: Sequence[str]) -> None:
        """Take note of what is odd; what was noted before is not repeated.

        Raises:
            VPrismError: there is something, and the command is strict.
        """
        self.warnings += [text for text in warnings if text not in self.warnings]
        if self.strict and self.warnings:
            raise VPrismError(f"--strict: {'; '.join(self.warnings)}")

    def finish(self, payload: dict[str, Any], lines: Sequence[str]) -> None:
        """Print the result and the warnings: one JSON object, or lines of text."""
        payload = {**payload, "warnings": self.warnings}
        lines = [*(f"warning: {text}" for text in self.warnings), *lines]
        text = dump_json(payload, indent=None) if self.as_json else "\n".join(lines) + "\n"
        sys.stdout.write(text)
        sys.stdout.flush()


class _CompileClock:
    """Adds up compilations; those inside another count once."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._depth = 0
        self._began = 0.0

    def start(self, event: Any) -> None:
        if self._depth == 0:
            self._began = time.perf_counter()
            self._console.compiling(_kernel_name(event))
        self._depth += 1

    def end(self, _: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._console.compile_seconds += time.perf_counter() - self._began
            self._console.compiled += 1


def _kernel_name(event: Any) -> str:
    dispatcher = (event.data or {}).get("dispatcher")
    return str(getattr(dispatcher, "__name__", "a kernel"))


def jsonable(value: Any) -> Any:
    """Return plain JSON values; NaN and infinities become null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def dump_json(payload: dict[str, Any], indent: int | None = 1) -> str:
    """Return strict JSON text with a final newline."""
    return json.dumps(jsonable(payload), indent=indent, allow_nan=False) + "\n"
