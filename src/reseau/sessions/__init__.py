"""Sessions: acquisitions that are measured live and can be computed again from the archive.

Examples
--------
Compute the results of a session again, in a program:

>>> from reseau.archive import Archive
>>> from reseau.sessions.conducting import rerun
>>> with Archive.open("archive") as archive:                            # doctest: +SKIP
...     all(each.same for each in rerun(archive.session("monday")))
True
"""
