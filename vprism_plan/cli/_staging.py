# SPDX-License-Identifier: BSD-3-Clause
"""Folders of results: filled aside, then moved in; what is stale there is removed."""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from vprism_plan.errors import VPrismError

PLAN_FILES = (
    "scene.png",
    "map.png",
    "plan.png",
    "map.safetensors",
    "meshes/object_*.ply",
    "trajectory.json",
    "report.json",
)
MESH_FILES = ("object_*.ply",)


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
    absent = _first_absent(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield aside
        written = sorted(p.relative_to(aside) for p in aside.rglob("*") if p.is_file())
        for pattern in ours:
            for stale in folder.glob(pattern):
                if stale.relative_to(folder) not in written:
                    stale.unlink()
        for name in written:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (aside / name).replace(folder / name)
        absent = None
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        if absent is not None and absent.is_dir():
            _remove_empty(absent)


def _first_absent(folder: Path) -> Path | None:
    """Return the topmost folder that would have to be made."""
    missing = [p for p in (folder, *folder.parents) if not p.exists()]
    return missing[-1] if missing else None


def _remove_empty(top: Path) -> None:
    for path in sorted([top, *(p for p in top.rglob("*") if p.is_dir())], reverse=True):
        if not any(path.iterdir()):
            path.rmdir()
