"""Render the templates of reports, with figures and tables numbered in order."""

from __future__ import annotations

from functools import partial
from itertools import count

import jinja2

__all__ = ["rendered"]


def rendered(template: str, **content: object) -> str:
    """Render a page from a template.

    Parameters
    ----------
    template : str
        File name of the template.
    content : object
        Values of the template; a missing one is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("reseau.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    # Numbered in order of appearance, which depends on the steps done.
    counters = {"figure": partial(next, count(1)), "table": partial(next, count(1))}
    return environment.get_template(template).render(content, **counters)
