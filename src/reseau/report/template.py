"""How every report becomes a page: its template, filled in, with figures and tables numbered as they come."""

from __future__ import annotations

from functools import partial
from itertools import count

import jinja2

__all__ = ["rendered"]


def rendered(template: str, **content: object) -> str:
    """A page of a template.

    Parameters
    ----------
    template : str
        Name of the file among the templates of reports.
    content : object
        What it asks for; a name that it asks for in vain is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("reseau.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    # Numbered as they come: which there are depends on what was done.
    counters = {"figure": partial(next, count(1)), "table": partial(next, count(1))}
    return environment.get_template(template).render(content, **counters)
