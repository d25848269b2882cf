"""Errors: one line each, and the exit status that belongs to them."""

from __future__ import annotations

import pytest

from reseau.core import errors
from reseau.core.errors import EstimationError, FormatError, ImageError, InputError, ReseauError, UsageError


def test_all_errors_have_one_base_class_and_are_exported() -> None:
    for name in errors.__all__:
        assert issubclass(getattr(errors, name), ReseauError)
    assert issubclass(ImageError, InputError)
    assert issubclass(FormatError, InputError)


@pytest.mark.parametrize(
    ("kind", "status"),
    [
        (UsageError, 2),
        (InputError, 2),
        (ImageError, 2),
        (FormatError, 2),
        (EstimationError, 1),
        (ReseauError, 1),
    ],
)
def test_wrong_use_and_input_exit_with_status_two_and_failures_with_one(
    kind: type[ReseauError], status: int
) -> None:
    assert kind("is wrong").exit_status == status


def test_an_error_names_place_problem_and_remedy_in_one_line() -> None:
    error = InputError("cannot be\n  read", where="a.png", do="look\tthere")
    assert str(error) == "a.png: cannot be read; look there"
    assert (error.what, error.where, error.do) == ("cannot be\n  read", "a.png", "look\tthere")
    assert str(InputError("is wrong")) == "is wrong"
