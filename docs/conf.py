# SPDX-License-Identifier: Apache-2.0
"""The documentation as a site: `make docs`.

Nothing is fetched, neither to build nor to read it.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from docutils.nodes import Element, SkipNode
from latex2mathml.converter import convert
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator
from sphinx_gallery.scrapers import figure_rst

from sst_ros import __version__

sys.path.insert(0, str(Path(__file__).parent))
from live_equations import live_scene, write_equations

project = "sst_ros"
copyright = "2026, the founders of sst_ros"
version = release = __version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
html_theme = "furo"
html_title = f"sst_ros {__version__}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"
exclude_patterns = [
    "joss/*",
    "gallery/*.ipynb",
    "gallery/*.py",
    "**/GALLERY_HEADER.rst",
]
suppress_warnings = ["config.cache"]  # the scraper of figures is a function
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_ivar = True

# The scripts write their pictures into their folder: they run in a copy of it.
EXAMPLES = Path(tempfile.mkdtemp(prefix="sst_ros_docs_")) / "examples"
shutil.copytree(Path(__file__).parents[1] / "examples", EXAMPLES)
NOT_RUN = ("bag_to_pandas", "controller", "push")
"""Examples that need a recording or a ROS 2 graph."""


def _figures(_block: Any, variables: dict[str, Any], gallery: dict[str, Any]) -> str:
    """Save the script's `figure`, for the gallery."""
    figure = variables["example_globals"].pop("figure", None)
    if not isinstance(figure, Figure):
        return ""
    path = next(variables["image_path_iterator"])
    figure.savefig(path, dpi=110)
    return str(figure_rst([path], gallery["src_dir"]))


sphinx_gallery_conf = {
    "examples_dirs": os.path.relpath(EXAMPLES, Path(__file__).parent),
    "gallery_dirs": "gallery",
    "filename_pattern": rf"/(?!{'|'.join(NOT_RUN)})\w+\.py$",
    "image_scrapers": (_figures,),
    "within_subsection_order": "ExampleTitleSortKey",
    "copyfile_regex": r".*\.yaml",
    "default_thumb_file": str(Path(__file__).parent / "mechanism.png"),
    "show_memory": False,
    "write_computation_times": False,
    "min_reported_time": 1e9,
    "remove_config_comments": True,
}


def _inline(page: HTML5Translator, node: Element) -> None:
    page.body.append(_mathml(node, "inline"))
    raise SkipNode


def _block(page: HTML5Translator, node: Element) -> None:
    page.body.append(f"<div>{_mathml(node, 'block')}</div>\n")
    raise SkipNode


def _mathml(node: Element, display: str) -> str:
    return convert(node.astext(), display=display)


def _plain(_app, what: str, _name, _object, _options, lines: list[str]) -> None:
    """Keep Napoleon from taking what precedes a colon for the type of a property."""
    if what == "property" and lines:
        lines[0] = lines[0].replace(": ", " - ")


def _finish(app: Sphinx, _error) -> None:
    """Write the equations of the first page; remove the copy of the examples."""
    path = Path(app.outdir) / "_static" / "live_equations.js"
    if path.parent.is_dir():
        path.write_text(write_equations(live_scene()), encoding="utf-8")
    shutil.rmtree(EXAMPLES.parent, ignore_errors=True)


def setup(app: Sphinx) -> None:
    """Write mathematics as MathML, which browsers draw without a script."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("autodoc-process-docstring", _plain, priority=400)
    app.connect("build-finished", _finish)
