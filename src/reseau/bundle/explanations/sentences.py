"""Sentences of the explanations: what each cause is, and what to do."""

from __future__ import annotations

from collections.abc import Sequence

EACH = "in each photograph"
"""How forms begin that are another in each photograph."""
_SENTENCES = {
    "lens": (
        "the camera model does not describe the lens",
        "leave out --model and --free, so that models are compared",
    ),
    "refocus": (
        "the principal distance or point changed between the photographs",
        "hold focus and zoom, switch off autofocus and stabilisation, and take the photographs anew",
    ),
    "other-camera": (
        "some photographs have another zoom, size or crop",
        "leave them out, or calibrate them by themselves",
    ),
    "rolling-shutter": (
        "camera or target moved while the lines of the image were read (rolling shutter)",
        "hold both still, or give --rolling-shutter with the time of a line",
    ),
    "motion": (
        "target or camera moved between exposures that count as one",
        "expose all cameras at once, or hold the target still",
    ),
    "target-shape": (
        "the target is not as flat, or not as regular, as it is held",
        "calibrate with --target free or auto, or fix the target to something flat",
    ),
    f"target-shape: {EACH}": (
        "the target bends, otherwise in each photograph",
        "fix it to something flat and take the photographs anew; the uncertainties contain it",
    ),
    "target-scale": (
        "the target was not printed with the proportions of its design",
        "measure both axes of the print and correct the design, or calibrate with --target free",
    ),
    "names": ("points have the names of others", "measure these photographs again, or leave the points out"),
    "blunders": ("single image points are wrong", "leave them out, or calibrate with --reject"),
    "noise": (
        "the image points scatter otherwise than their standard deviations say",
        "nothing: the uncertainties contain it",
    ),
    "unknown": (
        "the points of each photograph deviate together, in a way that none of the known causes explains",
        "look whether the target bends, or moves during the exposure; the uncertainties contain it",
    ),
}


def described(code: str, form: str = "") -> str:
    """What a cause is.

    Examples
    --------
    >>> described("lens")
    'the camera model does not describe the lens'
    """
    return _sentences(code, form)[0]


def _sentences(code: str, form: str) -> tuple[str, str]:
    """What a cause of a form is, and what to do."""
    return _SENTENCES.get(f"{code}: {form.partition(',')[0]}", _SENTENCES[code])


def advice(code: str, form: str, chosen: bool = False) -> str:
    """What to do; `chosen` where the model of the lens was chosen among others.

    Examples
    --------
    >>> advice("noise", "1.3")
    'nothing: the uncertainties contain it'
    """
    if code == "lens" and chosen:
        return "no model that was compared describes it better"
    if code == "lens" and form == "1 more":
        return "estimate the next coefficient too, or leave out --model"
    return _sentences(code, form)[1]


def listed_places(names: Sequence[str], what: str, most: int = 4) -> str:
    """Names in a sentence, of many the first and how many more.

    Examples
    --------
    >>> listed_places(["a", "b"], "image"), listed_places(list("abcdefg"), "image")
    ('images a, b', 'images a, b, c, d and 3 more')
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{what}{'s' * (len(names) != 1)} {', '.join(names[:most])}{more}"
