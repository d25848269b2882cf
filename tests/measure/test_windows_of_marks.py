"""Windows of marks: the sizes they share, and the filter that works on all of them."""

import numpy as np
import pytest
from scipy.ndimage import correlate

from reseau.measure.matching.patches import filtered
from reseau.measure.reseau.mark_windows import _joined


@pytest.mark.parametrize("reach", [1, 2, 5, 7])
@pytest.mark.parametrize("zeros", [0.0, 0.5])
def test_windows_are_filtered_as_by_scipy(reach: int, zeros: float) -> None:
    rng = np.random.default_rng(reach)
    kernel = rng.normal(size=(2 * reach + 1,) * 2) * (rng.random((2 * reach + 1,) * 2) >= zeros)
    kernel = kernel.astype(np.float32)
    images = rng.normal(size=(3, 17, 23)).astype(np.float32)
    inner = slice(reach, -reach)
    expected = np.stack([correlate(image.astype(float), kernel)[inner, inner] for image in images])
    assert np.abs(filtered(images, kernel) - expected).max() < 1e-5  # grey values of about 1


def test_few_windows_share_the_size_of_others_and_many_keep_their_own() -> None:
    sides, count = np.array([[41, 33], [41, 41], [49, 49], [121, 121]]), np.array([5, 60, 20, 40])
    joined, of = _joined(sides, count)
    assert (joined[of] >= sides).all()
    assert of[0] == of[1]
    assert len({int(k) for k in of[1:]}) == 3


def test_one_size_stays_as_it_is() -> None:
    joined, of = _joined(np.array([[41, 33]]), np.array([7]))
    assert joined.tolist() == [[41, 33]]
    assert of.tolist() == [0]
