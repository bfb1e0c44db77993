# SPDX-License-Identifier: BSD-3-Clause
"""`njit` for our kernels: numba's, whose cache notices edits of callees, and has a place anywhere.

numba compiles a cached function again when its own file has changed, not when a file has that it
calls into. So the stamp of ours is a digest of all kernel files: they may call one another.

numba keeps compiled code in NUMBA_CACHE_DIR, else beside the source, else in the user's cache
folder, and refuses to define a function if it can write to none of them, as in a read-only
installation without a home. Then a folder of the user's own among the temporary files is taken,
and without one the code is compiled anew in every process.
"""

import functools
import hashlib
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_settings: Any = numba.config  # its names are made at run time


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return `numba.njit(**options)`, which cannot fail for want of a cache folder."""

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return _stamped(numba.njit(**options)(function))
        except RuntimeError:  # "cannot cache function": raised where it is defined, not compiled
            folder = own_temporary_folder()
        if folder is None:
            return numba.njit(**{**options, "cache": False})(function)
        before = _settings.CACHE_DIR
        _settings.CACHE_DIR = str(folder)  # read while a function is defined, and only then
        try:
            return _stamped(numba.njit(**options)(function))
        finally:
            _settings.CACHE_DIR = before

    return compiled


def is_cached(dispatcher: Any) -> bool | None:
    """Whether code of a kernel as it is now lies on disk; None where nothing can be kept."""
    file = getattr(dispatcher._cache, "_cache_file", None)
    return None if file is None else bool(file._load_index())


def _stamped(dispatcher: Any) -> Any:
    """Make cached code depend on all kernel files."""
    dispatcher._cache._cache_file._source_stamp = _digest()
    return dispatcher


@functools.cache
def _digest() -> str:
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@functools.cache
def own_temporary_folder() -> Path | None:
    """A folder among the temporary files that nobody but this user can write to, or None.

    What lies in a cache is run as code, and everybody may make files in /tmp. So a folder that
    is there already is taken only if it is one, belongs to this user and is closed to others.
    """
    if not hasattr(os, "getuid"):
        return None
    try:
        folder = Path(tempfile.gettempdir()) / f"vprism_plan-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        closed = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
        if not closed or found.st_uid != os.getuid():
            return None
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None
