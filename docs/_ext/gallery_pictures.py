# SPDX-License-Identifier: BSD-3-Clause
"""How the gallery runs the examples: each writes its picture where it is told to.

Examples that take a map are given one, so that the scene is fitted once: the first example
shows that, and the code that would fit it is the same line in all of them.
"""

import logging
import shutil
from pathlib import Path
from typing import Any

from demo_map import saved
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx_gallery.scrapers import figure_rst


def setup(app: Sphinx) -> dict[str, bool]:
    """Check at the end that every example was run and drew something."""
    logging.getLogger("vprism_plan").setLevel(logging.WARNING)  # else it fills the pages
    app.connect("build-finished", _require_pictures)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def arguments(gallery_conf: dict[str, Any], script_vars: dict[str, Any]) -> list[str]:
    """Return the command line of an example."""
    picture = _picture(gallery_conf, script_vars["src_file"])
    picture.parent.mkdir(parents=True, exist_ok=True)
    picture.unlink(missing_ok=True)
    script_vars["example_globals"]["__file__"] = script_vars["src_file"]
    if '"--map"' not in Path(script_vars["src_file"]).read_text(encoding="utf-8"):
        return ["--picture", str(picture)]
    return ["--picture", str(picture), "--map", str(saved(picture.parent))]


def scrape(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Put the picture under the block that wrote it."""
    picture = _picture(gallery_conf, block_vars["src_file"])
    if not picture.is_file():
        return ""
    shown = next(block_vars["image_path_iterator"])
    shutil.move(picture, shown)
    return figure_rst([shown], gallery_conf["src_dir"])


def _picture(gallery_conf: dict[str, Any], script: str) -> Path:
    return Path(gallery_conf["src_dir"]).parent / "build" / "docs" / f"{Path(script).stem}.png"


def _require_pictures(app: Sphinx, problem: Exception | None) -> None:
    if problem is not None or not app.config.sphinx_gallery_conf["plot_gallery"]:
        return
    drawn = Path(app.srcdir) / "examples" / "images"
    for script in sorted((Path(app.srcdir).parent / "examples").glob("[0-9]*.py")):
        if not (drawn / f"sphx_glr_{script.stem}_001.png").is_file():
            raise ExtensionError(f"{script.name} wrote no picture; it must honour --picture FILE")
