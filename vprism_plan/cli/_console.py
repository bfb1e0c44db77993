# SPDX-License-Identifier: BSD-3-Clause
"""What a command puts out: progress and times, the result, folders of files."""

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vprism_plan._files import jsonable
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
        self.as_json, self.strict = as_json, strict
        self.warnings: list[str] = []
        self.timings: dict[str, float] = {}
        self.compile_seconds, self.compiled = 0.0, 0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block under `name` and show it while it runs."""
        began = time.perf_counter()
        spinner: Any = nullcontext()
        if sys.stderr.isatty():
            from rich.console import Console as RichConsole

            spinner = RichConsole(stderr=True).status(f"{name} ...")
        with spinner as status, self._watch_compiler(name, status):
            try:
                yield
            finally:
                self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - began

    @contextmanager
    def _watch_compiler(self, stage: str, status: "Status | None") -> Iterator[None]:
        """Count what numba compiles (not what it loads from its cache); what is compiled inside
        another compilation is part of it."""
        from numba.core import event

        console, depth, began = self, 0, 0.0

        class Listener(event.Listener):
            def on_start(self, event: Any) -> None:
                nonlocal depth, began
                depth += 1
                if depth > 1:
                    return
                began = time.perf_counter()
                if status is not None:
                    dispatcher = (event.data or {}).get("dispatcher")
                    status.update(
                        f"{stage}: compiling {getattr(dispatcher, '__name__', 'a kernel')} (on "
                        f"first use only, {console.compile_seconds:.0f} s so far) ..."
                    )

            def on_end(self, event: Any) -> None:
                nonlocal depth
                depth -= 1
                if depth == 0:
                    console.compile_seconds += time.perf_counter() - began
                    console.compiled += 1

        with event.install_listener("numba:compile", Listener()):
            yield

    def time_line(self) -> str:
        """Return the stages and their seconds as one line."""
        stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.timings.items())
        if not self.compiled:
            return stages
        return (
            f"{stages}; {self.compile_seconds:.1f} s of it compiled {self.compiled} kernels "
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

    def about(self) -> dict[str, Any]:
        """Return what every result says beside the answer."""
        return {
            "timings": self.timings,
            "compile_seconds": self.compile_seconds,
            "compiled_kernels": self.compiled,
            "warnings": self.warnings,
        }

    def finish(self, payload: dict[str, Any], lines: Sequence[str]) -> None:
        """Print the result, the times and the warnings: one JSON object, or lines of text."""
        lines = [*(f"warning: {text}" for text in self.warnings), *lines]
        if self.as_json:
            sys.stdout.write(dump_json({**payload, **self.about()}, indent=None))
        else:
            sys.stdout.write("\n".join(lines) + "\n")
        sys.stdout.flush()


def dump_json(payload: dict[str, Any], indent: int | None = 1) -> str:
    """Return strict JSON text with a final newline; NaN and infinities become null."""
    return json.dumps(jsonable(payload), indent=indent, allow_nan=False) + "\n"


@contextmanager
def staged(folder: Path, ours: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder beside `folder`; on success its files are renamed into it.

    Files in `folder` that match `ours` and were not written again are removed: a
    trajectory of an earlier run must not look like the answer to this one. On any
    failure, KeyboardInterrupt included, `folder` stays as it was.

    Raises:
        VPrismError: `folder` exists and is not a folder.
    """
    if folder.exists() and not folder.is_dir():
        raise VPrismError(f"{folder} is a file; --output must name a folder")
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(
            prefix=f".{folder.name}-", dir=folder.parent, ignore_cleanup_errors=True
        ) as name:
            aside = Path(name)
            yield aside
            written = sorted(p.relative_to(aside) for p in aside.rglob("*") if p.is_file())
            for pattern in ours:
                for stale in folder.glob(pattern):
                    if stale.relative_to(folder) not in written:
                        stale.unlink()
            for file in written:
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (aside / file).replace(folder / file)
    except BaseException:
        for path in made:
            with suppress(OSError):  # absent, or no longer empty
                path.rmdir()
        raise
