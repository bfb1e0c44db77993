# SPDX-License-Identifier: BSD-3-Clause
"""Files appear whole or not at all, and whatever is in one that is read, it fails in one line."""

import json
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from vprism_plan.errors import MissingDependencyError, VPrismError

_LONGEST = 1000  # characters of a message about a file
MOST_TEXT = 2**25  # bytes of a text that is read: 32 MiB


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path with the same suffix; on success it becomes `path`.

    On any failure, KeyboardInterrupt included, the temporary file is removed and
    whatever was at `path` before stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes files private; a result should have the user's usual rights.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except BaseException:
        with suppress(FileNotFoundError):
            temporary.unlink()
        raise


def cache_folder(name: str) -> Path | None:
    """A folder for what can be made again: of the user's cache, else of the temporary files as for
    compiled code (`_kernels.jit`); None where none can be written to."""
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
        folder = home.absolute() / "vprism_plan" / name
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # not writable, or no home
        from vprism_plan._kernels.jit import own_temporary_folder

        return own_temporary_folder()


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text to `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def reading(
    path: str | Path, what: str, error: type[VPrismError], most: int | None = None
) -> Iterator[None]:
    """Let nothing but errors of this package out of a block that reads a file.

    A file from elsewhere may be damaged or made on purpose, and readers then raise anything:
    RecursionError, MemoryError, TypeError, their own. Messages are cut to one line, because
    what they quote comes from the file.

    Args:
        path: the file, or a folder of several.
        what: it should be: "a readable map".
        error: to raise.
        most: bytes; a larger file is refused unread.

    Raises:
        VPrismError: `error`, or what the block raises of this kind.
    """
    try:
        if most is not None and Path(path).stat().st_size > most:
            raise error(
                f"{path} has {Path(path).stat().st_size:,} bytes; at most {most:,} are read"
            )
        yield
    except VPrismError as known:
        known.args = (one_line(known),)
        raise
    except Exception as unknown:
        raise error(
            one_line(f"'{path}' is not {what}: {type(unknown).__name__}: {unknown}")
        ) from unknown


def one_line(text: object, most: int = _LONGEST) -> str:
    """Return a text as one printable line, its middle left out if it is long."""
    line = " ".join(str(text).split())
    if len(line) > most:
        line = f"{line[: most // 2]} [...] {line[-most // 2 :]}"
    return "".join(c if c.isprintable() else "?" for c in line)


def read_json(path: Path, error: type[VPrismError]) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        VPrismError: `error`, if there is none.
    """
    if not path.is_file():
        raise error(f"{path} is missing")
    with reading(path, "readable JSON", error, MOST_TEXT):
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise error(f"{path} holds a {type(content).__name__}; it must be an object")
        return content


def jsonable(value: Any) -> Any:
    """Return a value as strict JSON knows it: what has a `to_dict` as that, tuples and arrays as
    lists, paths as text, NaN and infinities as null."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if hasattr(value, "tolist"):  # numpy's
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): jsonable(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def optional(module: str, extra: str, needs: str) -> ModuleType:
    """Import a module that an extra of this package brings.

    Raises:
        MissingDependencyError: `needs` ("recordings need"), the package and how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise MissingDependencyError(
            f"{needs} {name}, which is not installed: pip install 'vprism_plan[{extra}]'"
        ) from error
