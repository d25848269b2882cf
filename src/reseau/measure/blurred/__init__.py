"""Blurred targets: image coordinates of the corresponding rays, by matching with images formed by rays.

In a blurred image the centre of density is not the image of the target's point: coma, colour and vignetting
shift it, and it may be the image of another point at each place of the field. The image of the target is
formed by rays (:mod:`reseau.optics.lenses.images`) and matched with the frame; the result is the place of the
corresponding ray, the principal ray of one wavelength (Meid 1992, sections 2.2 and 3.2). The matcher is that
of all other marks: two shifts, contrast and background, the width of the remaining blur, and, if wanted,
parameters of the optics such as focus and media.

Motion during the exposure is another physical cause (:mod:`reseau.measure.blurred.motion`).
"""

from .estimate import estimate_optics
from .measure import BlurredOptions, measure_blurred

__all__ = ["BlurredOptions", "estimate_optics", "measure_blurred"]
