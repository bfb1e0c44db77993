# SPDX-License-Identifier: BSD-3-Clause
"""One reference page per package, of everything its `__all__` names, written before each build."""

import inspect
from importlib import import_module
from pathlib import Path

from sphinx.application import Sphinx

PACKAGES = (
    "perception",
    "mapping",
    "world",
    "robots",
    "collision",
    "planning",
    "trajopt",
    "viz",
    "simulation",
)


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages into reference/generated."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _write(app: Sphinx) -> None:
    folder = Path(app.srcdir) / "reference" / "generated"
    folder.mkdir(parents=True, exist_ok=True)
    pages = {package: page_of(f"vprism_plan.{package}") for package in PACKAGES}
    pages["errors"] = page_of("vprism_plan.errors")
    for name, text in pages.items():
        file = folder / f"{name}.rst"
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def page_of(package: str) -> str:
    """Return the page of a package as reStructuredText."""
    module = import_module(package)
    summary = (inspect.getdoc(module) or "").split("\n\n")[0].replace("`", "``")
    lines = [package, "=" * len(package), "", summary, "", f".. currentmodule:: {package}", ""]
    for name in public_names(module):
        thing = getattr(module, name)
        if inspect.isclass(thing):
            lines += [f".. autoclass:: {name}", ""]
        elif callable(thing):
            lines += [f".. autofunction:: {name}", ""]
    return "\n".join(lines)


def public_names(module: object) -> list[str]:
    """Return what a package offers, in the order of its `__all__`."""
    stated = getattr(module, "__all__", None)
    if stated is not None:
        return sorted(stated, key=str.lower)
    home = module.__name__  # type: ignore[attr-defined]
    found = {
        name
        for name, thing in vars(module).items()
        if not name.startswith("_")
        and callable(thing)
        and f"{getattr(thing, '__module__', '')}.".startswith(f"{home}.")
    }
    return sorted(found, key=str.lower)
