# SPDX-License-Identifier: Apache-2.0
"""The pages as a site: `make docs`. Nothing is fetched, neither to build it nor to look at it."""

from docutils.nodes import Element, SkipNode
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

project = "sst_ros"
copyright = "2026, the founders of sst_ros"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = "sst_ros"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_ivar = True


def _inline(page: HTML5Translator, node: Element) -> None:
    page.body.append(_mathml(node, "inline"))
    raise SkipNode


def _block(page: HTML5Translator, node: Element) -> None:
    page.body.append(f"<div>{_mathml(node, 'block')}</div>\n")
    raise SkipNode


def _mathml(node: Element, display: str) -> str:
    return convert(node.astext(), display=display)


def _plain(_app, what: str, _name, _object, _options, lines: list[str]) -> None:
    """Keep Napoleon from taking what stands before a colon for the type of a property."""
    if what == "property" and lines:
        lines[0] = lines[0].replace(": ", " - ")


def setup(app: Sphinx) -> None:
    """Write mathematics as MathML, which browsers draw without a script."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("autodoc-process-docstring", _plain, priority=400)
