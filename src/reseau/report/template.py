"""Render the templates of reports, with figures and tables numbered in order."""

from __future__ import annotations

import re
from functools import partial
from itertools import count

import jinja2
from markupsafe import Markup

TEMPLATES = (
    "applied.html.j2",
    "blurred_network.html.j2",
    "bundle.html.j2",
    "certificate.html.j2",
    "edges.html.j2",
    "oscilloscope.html.j2",
    "roll.html.j2",
    "sensor.html.j2",
)
"""Those of pages; the others are parts."""
_WIDE_PT = 450.0
# Of a drawing of 8.6 inches that is as wide as the page.
_REM_PER_PT = 59 / 619.2


def rendered(template: str, **content: object) -> str:
    """Render a page from a template.

    Parameters
    ----------
    template : str
        File name of the template.
    content : object
        Values of the template; a missing one is an error.
    """
    # Numbered in order of appearance, which depends on the steps done.
    counters = {"figure": partial(next, count(1)), "table": partial(next, count(1))}
    return environment().get_template(template).render(content, **counters)


def environment(package: str = "reseau.report", folder: str = "templates") -> jinja2.Environment:
    """Return the templates of a package, and what they may use."""
    found = jinja2.Environment(
        loader=jinja2.PackageLoader(package, folder),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    found.filters["named_by"] = _named_by
    return found


def _named_by(svg: str, element: str) -> Markup:
    """An SVG element as one picture for screen readers, with the text of another element as its name.

    Wide drawings are scrolled on a narrow page: their text would be too small. Narrow ones are not enlarged,
    so that all have text of one size.
    """
    named = str(svg).replace("<svg", f'<svg role="img" aria-labelledby="{element}"', 1)
    width = re.search(r'^<svg [^>]*?\bwidth="([\d.]+)pt"', named)
    wide = width is not None and float(width[1]) > _WIDE_PT
    if width is not None and not wide:
        named = named.replace("<svg", f'<svg style="max-width: {_REM_PER_PT * float(width[1]):.1f}rem"', 1)
    return Markup(f'<div class="wide" tabindex="0">{named}</div>' if wide else named)
