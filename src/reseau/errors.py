"""The errors that leave a public call, and nothing else does.

::

    ReseauError
    ├── UsageError           arguments that cannot be meant together            exit status 2
    ├── InputError           a file or a value from outside that cannot be used exit status 2
    │   ├── ImageError       … that should be an image
    │   └── FormatError      … that should be one of the project's documents
    └── EstimationError      an estimate that was required could not be had     exit status 1

Each says in one line *what* is wrong, *where*, and what to *do*. An estimator that fails does not raise: it
returns a falsy value with its reason; `EstimationError` is for those who must have the estimate.
"""

from __future__ import annotations

__all__ = ["EstimationError", "FormatError", "ImageError", "InputError", "ReseauError", "UsageError"]


class ReseauError(Exception):
    """Root of the tree; carries one line for the user.

    Parameters
    ----------
    what : str
        What is wrong.
    where : object, optional
        The file, key, mark or argument it is about; named first.
    do : str, optional
        What would help; named last.

    Examples
    --------
    >>> str(ReseauError("is all black", where="photo1.png", do="open the shutter"))
    'photo1.png: is all black; open the shutter'
    """

    exit_status = 1

    def __init__(self, what: str, *, where: object = None, do: str | None = None) -> None:
        self.what, self.where, self.do = what, where, do
        line = what if where is None else f"{where}: {what}"
        super().__init__(" ".join((line if do is None else f"{line}; {do}").split()))


class UsageError(ReseauError):
    """Arguments that cannot be meant together."""

    exit_status = 2


class InputError(ReseauError):
    """A file or a value from outside that cannot be used."""

    exit_status = 2


class ImageError(InputError):
    """A file or an array that should be an image and is none we can measure in."""


class FormatError(InputError):
    """A document that does not keep to its schema."""


class EstimationError(ReseauError):
    """An estimate that was required could not be had."""
