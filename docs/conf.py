# SPDX-License-Identifier: BSD-3-Clause
"""The documentation site: `make docs` builds it into build/docs; warnings are errors."""

import sys
from pathlib import Path

import vprism_plan

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_ext"))

project = "vprism_plan"
author = "the vprism_plan authors"
copyright = author
release = version = vprism_plan.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "mathml",
    "api_pages",
    "command_help",
    "docstrings",
    "gallery_pictures",
    "planner_table",
    "stage_pictures",
]
exclude_patterns = ["_ext", "**/README.md"]
html_theme = "furo"
html_title = f"vprism_plan {version}"
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_default_options = {
    "members": True,
    "member-order": "bysource",
    "inherited-members": "object, Module, Exception, tuple",
}
autodoc_typehints = "none"  # shapes and units are in the docstrings
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [
    (name, "params_style") for name in ("Kernel", "Hinge points", "Learning", "Negative samples")
]
python_use_unqualified_type_names = True

# Every example is run, once: a failure, or one that draws nothing, fails the build.
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "examples",
    "filename_pattern": r"/\d\d",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "reset_argv": "gallery_pictures.arguments",
    "image_scrapers": ("gallery_pictures.scrape",),
    "reset_modules": (),
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
    "plot_gallery": True,
}
