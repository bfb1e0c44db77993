# SPDX-License-Identifier: BSD-3-Clause
"""Equations as MathML, which browsers draw themselves: no network, no scripts, no TeX."""

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer `mathml`."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _inline(writer, node: nodes.math) -> None:
    writer.body.append(_translate(node, block=False))
    raise nodes.SkipNode


def _block(writer, node: nodes.math_block) -> None:
    # Not class "math": the theme would give it scroll bars. Wide ones still scroll sideways.
    style = "overflow-x: auto; overflow-y: hidden; padding: 0.4em 0"
    writer.body.append(f'<div style="{style}">{_translate(node, block=True)}</div>')
    raise nodes.SkipNode


def _translate(node: nodes.Element, *, block: bool) -> str:
    text = node.astext()
    try:
        return tex2mathml(text, as_block=block)
    except MathError as error:
        raise ExtensionError(f"{node.source}: cannot translate {text!r}: {error}") from error
