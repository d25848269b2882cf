"""Sphinx: the pages of this folder and the reference of the API, built without a network by `make docs`."""

import re
import sys
import types
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpydoc.docscrape_sphinx
from docutils import nodes
from jinja2 import FileSystemBytecodeCache
from jinja2.sandbox import SandboxedEnvironment
from latex2mathml.converter import convert
from sphinx.domains.python import PythonDomain
from sphinx.transforms import SphinxTransform

_ROOT = Path(__file__).resolve().parents[1]
for _folder in ("src", "drivers", "sims", "docs"):
    sys.path.insert(0, str(_ROOT / _folder))

from generated import schemas, write_pages  # noqa: E402

from reseau.core.version import __version__  # noqa: E402

project = "reseau"
author = "the authors of reseau"
copyright = author
version = release = __version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "myst_parser",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["reference/generated/names.md", "api/_templates", "gallery"]

templates_path = ["api/_templates"]
source_suffix = {".rst": "restructuredtext", ".md": "markdown"}
root_doc = "index"

autosummary_generate = True
autosummary_imported_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_use_type_comments = False
# Optional libraries: the reference is the same where they are not installed.
autodoc_mock_imports = ["gi"]
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
numpydoc_xref_param_type = False

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# Links between the pages are checked; a file that is not a page is copied to the site for download.
# Names of types in signatures that two packages define, as Frame, are linked to the first.
suppress_warnings = ["misc.highlighting_failure", "ref.python"]
keep_warnings = True

# The examples of `gallery` are run, and become the pages of `examples`.
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "examples",
    "filename_pattern": r"\.py$",
    "subsection_order": [
        f"gallery/{name}" for name in ("targets", "images", "networks", "uncertainty", "sensors")
    ],
    "within_subsection_order": "FileNameSortKey",
    "nested_sections": False,
    "image_scrapers": ("themes.scraper",),
    "reset_modules": ("themes.reset",),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "min_reported_time": 3600,
}

html_title = "reseau"
html_theme = "pydata_sphinx_theme"
html_theme_options = {
    "show_nav_level": 1,
    # Of a thousand pages of the reference, those beside the page shown would take a third of the build.
    "collapse_navigation": True,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 8,
    "secondary_sidebar_items": ["page-toc"],
}
# A section of one page has no pages beside it.
html_sidebars: dict[str, list[str]] = {"conventions": []}
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
# Formulas are MathML in the pages: neither the build nor the reader's browser needs a network.
html_math_renderer = "mathml"


def _skip(app: Any, what: str, name: str, obj: object, skip: bool, options: Any) -> bool | None:
    """Leave out aliases of generic types, whose signature autodoc cannot format."""
    return True if isinstance(obj, types.GenericAlias) else None


def _magnitudes(app: Any, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Let |v| in a docstring be a magnitude; the project has no substitutions of reStructuredText."""
    for i, line in enumerate(lines):
        if "`" not in line and "\\" not in line:
            lines[i] = re.sub(r"\|(\w)\|", r"\\|\1\\|", line)


def _pages(app: Any, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Link a page that a docstring names by its file."""
    for i, line in enumerate(lines):
        lines[i] = re.sub(r"``docs/([\w/-]+)\.md``", r":doc:`docs/\1.md </\1>`", line)


class _Themes(SphinxTransform):
    """Show `picture-dark.png` beside `picture.png` on dark pages in its place."""

    default_priority = 400

    def apply(self, **options: Any) -> None:
        """Give every picture that has one its twin."""
        for image in list(self.document.findall(nodes.image)):
            path = Path(image["uri"])
            dark = path.with_name(f"{path.stem}-dark{path.suffix}")
            chosen = {"only-light", "only-dark"} & set(image["classes"])
            if chosen or not (Path(self.document["source"]).parent / dark).exists():
                continue
            twin = image.deepcopy()
            twin["uri"] = dark.as_posix()
            twin["classes"].append("only-dark")
            image["classes"].append("only-light")
            image.parent.insert(image.parent.index(image) + 1, twin)


def _mathml(node: nodes.Node, display: str) -> str:
    """Convert a formula from LaTeX to MathML; an unknown command is an error."""
    found = convert(node.astext(), display=display)
    if "\\" in found:
        raise ValueError(f"{node.source}: formula with an unknown command: {node.astext()}")
    return str(found)


def _inline_math(translator: Any, node: nodes.Element) -> None:
    translator.body.append(_mathml(node, "inline"))
    raise nodes.SkipNode


def _display_math(translator: Any, node: nodes.Element) -> None:
    body = [translator.starttag(node, "div", CLASS="math notranslate"), _mathml(node, "block"), "</div>\n"]
    if node.get("number"):
        body.insert(1, f'<span class="eqno">({node["number"]})</span>')
    translator.body.extend(body)
    raise nodes.SkipNode


def _generated(app: Any) -> None:
    """Write the pages that are generated from the program, and the JSON Schemas beside the pages."""
    write_pages()
    folder = Path(app.outdir) / "schemas"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in schemas().items():
        (folder / name).write_text(text, "utf-8")


def setup(app: Any) -> None:
    """Connect to Sphinx."""
    # A quarter of the build: one template is compiled for each docstring, and names are looked for among all.
    numpydoc.docscrape_sphinx.SandboxedEnvironment = partial(  # type: ignore[misc, assignment]
        SandboxedEnvironment, bytecode_cache=FileSystemBytecodeCache()
    )
    PythonDomain.find_obj = cache(PythonDomain.find_obj)  # type: ignore[method-assign]
    app.add_transform(_Themes)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_display_math, None))
    app.connect("autodoc-process-docstring", _magnitudes)
    app.connect("autodoc-process-docstring", _pages)
    app.connect("autodoc-skip-member", _skip)
    app.connect("builder-inited", _generated)
