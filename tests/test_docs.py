# SPDX-License-Identifier: BSD-3-Clause
"""The site's sources hang together; building it (`make docs`) also runs every example."""

import ast
import inspect
import io
import re
import sys
from importlib import import_module

import pytest

LINK = re.compile(r"\]\(([^)\s]+)\)")


@pytest.fixture(scope="module")
def docs(repository):
    return repository / "docs"


@pytest.fixture(scope="module")
def site_code(docs):
    """The site's own extensions, importable."""
    sys.path.insert(0, str(docs / "_ext"))
    yield
    sys.path.remove(str(docs / "_ext"))


def pages(docs):
    written = {"examples", "generated", "_ext"}
    return [p for p in docs.rglob("*.md") if not written & set(p.relative_to(docs).parts)]


def examples(repository):
    return sorted((repository / "examples").glob("*.py"))


def test_every_page_is_reachable_from_the_index(docs):
    reached, waiting = set(), [docs / "index.md"]
    while waiting:
        page = waiting.pop()
        if page in reached:
            continue
        reached.add(page)
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), flags=re.S):
            names = [n.strip() for n in block.splitlines() if n.strip() and n.strip()[0] != ":"]
            for name in names:
                if "*" in name:
                    waiting += sorted(page.parent.glob(f"{name}.md"))
                elif "generated/" not in name and not name.startswith("examples/"):
                    waiting.append(page.parent / f"{name}.md")
                    assert waiting[-1].is_file(), f"{page.name} lists {name}"
    assert set(pages(docs)) == reached


def test_links_lead_to_pages_pictures_and_examples(docs, repository):
    for page in pages(docs):
        if page.name == "changelog.md":
            continue
        for target in LINK.findall(page.read_text()):
            if re.match(r"[a-z]+:", target):
                continue
            path = (page.parent / target.split("#")[0]).resolve()
            inside = path.relative_to(docs).parts
            if inside[0] == "examples":  # pages and pictures that the build makes
                stem = re.sub(r"^sphx_glr_|_\d{3}\.png$", "", path.name)
                path = repository / "examples" / f"{stem}.py"
            elif "generated" in inside:
                continue
            assert path.exists() or path.with_suffix(".md").exists(), f"{page.name}: {target}"


def test_every_example_is_numbered_explained_and_mentioned_in_the_pages(repository, docs):
    told = "".join(page.read_text() for page in pages(docs))
    for script in examples(repository):
        assert re.fullmatch(r"\d\d[a-z]?_\w+", script.stem), script.name
        text = ast.get_docstring(ast.parse(script.read_text()))
        title, underline = text.splitlines()[:2]
        assert underline == "=" * len(title), f"{script.name}: the page needs a title"
        assert f"python examples/{script.name}" in text, f"{script.name} does not say how to run it"
        assert "--picture" in script.read_text(), f"{script.name} draws nothing"
        assert script.stem in told, f"no page links to {script.name}"


def test_examples_are_numbered_without_gaps(repository):
    numbers = sorted({int(script.name[:2]) for script in examples(repository)})
    assert numbers == list(range(1, len(numbers) + 1))


def test_every_package_has_a_reference_page_and_every_command_its_help(docs, site_code, repository):
    api_pages = pytest.importorskip("api_pages", reason="sphinx is not installed (extra `docs`)")
    packages = {p.parent.name for p in (repository / "vprism_plan").glob("*/__init__.py")}
    assert packages - {"cli", "_kernels"} == set(api_pages.PACKAGES)
    listed = (docs / "reference" / "api.md").read_text()
    for package in (*api_pages.PACKAGES, "errors"):
        assert f"generated/{package}\n" in listed
    from vprism_plan.cli import _FILES

    shown = (docs / "reference" / "command_line.md").read_text()
    assert set(re.findall(r"```\{command-help\} (\w+)\n", shown)) == set(_FILES)


def test_equations_can_be_drawn(docs):
    pytest.importorskip("docutils", reason="sphinx is not installed (extra `docs`)")
    from docutils.utils.math.latex2mathml import tex2mathml

    for page in pages(docs):
        text = page.read_text()
        inline = re.sub(r"```.*?```|\$\$.*?\$\$|`[^`]*`", "", text, flags=re.S)
        for formula in re.findall(r"\$\$(.+?)\$\$", text, flags=re.S):
            assert "<math" in tex2mathml(formula, as_block=True)
        for formula in re.findall(r"\$([^$\n]+)\$", inline):
            assert "<math" in tex2mathml(formula)


def test_docstrings_of_public_names_read_as_markup(site_code):
    pytest.importorskip("sphinx", reason="sphinx is not installed (extra `docs`)")
    import api_pages
    import docstrings
    from docutils import nodes
    from docutils.core import publish_doctree
    from docutils.parsers.rst import roles
    from sphinx.ext.napoleon import Config, GoogleDocstring

    for role in ("meth", "class", "func", "attr", "doc"):
        roles.register_generic_role(role, nodes.literal)
    headings = ("Kernel", "Hinge points", "Learning", "Negative samples")
    config = Config(
        napoleon_use_ivar=True, napoleon_custom_sections=[(h, "params_style") for h in headings]
    )
    markup, places = [], {}
    for package in (*api_pages.PACKAGES, "errors"):
        module = import_module(f"vprism_plan.{package}")
        for name in api_pages.public_names(module):
            for place, text in documented(f"{package}.{name}", getattr(module, name)):
                lines = inspect.cleandoc(text).split("\n")
                docstrings.process(None, "", place, None, None, lines)
                places[len(markup)] = place
                fields = str(GoogleDocstring(lines, config, what="class"))
                markup += [*fields.split("\n"), "", "..", ""]
    said = io.StringIO()
    publish_doctree(
        "\n".join(markup), settings_overrides={"warning_stream": said, "report_level": 2}
    )
    complaints = [
        f"{next(places[n] for n in sorted(places, reverse=True) if n < int(line))}: {text}"
        for line, text in re.findall(r"<string>:(\d+): (.*)", said.getvalue())
    ]
    assert not complaints, "\n".join(complaints)


def documented(place, thing):
    """A public thing's docstring, and those of a class's own public methods."""
    if thing.__doc__:
        yield place, thing.__doc__
    for home in thing.__mro__ if inspect.isclass(thing) else ():
        if home.__module__.startswith("vprism_plan"):
            for name, member in vars(home).items():
                plain = getattr(member, "fget", None) or getattr(member, "__func__", member)
                if inspect.isfunction(plain) and plain.__doc__ and not name.startswith("_"):
                    yield f"{place}.{name}", plain.__doc__


def test_pages_name_source_files_that_are_there(docs, repository):
    """Of the way things go, and of every stage: a file that moves takes its name along."""
    everywhere = {path.name for path in (repository / "vprism_plan").rglob("*.py")}
    for page in [docs / "architecture.md", *sorted((docs / "stages").glob("*.md"))]:
        for name in re.findall(r"`([a-z_/]+\.py)`", page.read_text()):
            below = [repository / base / name for base in ("", "vprism_plan", "vprism_plan/world")]
            found = any(path.exists() for path in below) if "/" in name else name in everywhere
            assert found, f"{page.name} names {name}"
