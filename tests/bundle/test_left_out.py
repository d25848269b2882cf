"""Images that are left out: predicted in closed form as by adjustments without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, adjust_network, example_network
from reseau.bundle.modelling.left_out import Information, information_of
from reseau.core.data import Array
from reseau.core.failure import Failure

FRAME = ("c", "x0", "y0")


def adjusted(network: Network, free: tuple[str, ...]) -> tuple[float, Information, Array]:
    given = network.cameras[0]
    values = np.where([name in free for name in given.names], given.values, 0.0)
    camera = replace(given, free=free, values=values)
    result = adjust_network(replace(network, cameras=(camera,)))
    assert not isinstance(result, Failure)
    found = information_of(result.fit)
    assert found is not None
    return result.fit.cost, found, result.fit.values.cameras[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("free", "linear"), [((*FRAME, "K1"), 2e-3), ((*FRAME, "K1", "K2", "P1", "P2"), 0.01), (FRAME, 0.05)]
)
def test_squares_of_an_image_are_what_the_others_alone_do_not_leave(
    free: tuple[str, ...], linear: float
) -> None:
    """The points of the target are unknown, and the same for all images; K1 is 27 sigma."""
    network = example_network()
    _, found, _ = adjusted(network, (*FRAME, "K1"))
    prediction = found.predicted(free)
    whole, _, values = adjusted(network, free)
    assert prediction.cost == pytest.approx(whole, rel=linear)
    assert prediction.values[: len(values)] == pytest.approx(values, rel=linear, abs=3e-3)
    for image in (0, 5):
        rest, _, _ = adjusted(network.select(network.image_of != image), free)
        assert prediction.squares[image] == pytest.approx(whole - rest, rel=10 * linear)


def test_information_of_an_image_is_what_the_others_lack() -> None:
    network = example_network()
    _, found, _ = adjusted(network, (*FRAME, "K1"))
    _, rest, _ = adjusted(network.select(network.image_of != 2), (*FRAME, "K1"))
    at = [found.names.index(name) for name in (*FRAME, "K1")]
    lacking = (found.normal - found.own[2])[np.ix_(at, at)]
    assert lacking == pytest.approx(rest.normal[np.ix_(at, at)], rel=0.02, abs=0.02 * np.abs(lacking).max())


def test_images_that_differ_in_the_principal_distance_have_a_larger_variance_factor() -> None:
    network = example_network()
    _, sound, _ = adjusted(network, (*FRAME, "K1"))
    factor = np.random.default_rng(2).normal(1, 5e-3, len(network.images))[network.image_of]
    centre = np.array([319.5, 239.5])
    _, found, _ = adjusted(
        replace(network, xy=centre + factor[:, None] * (network.xy - centre)), (*FRAME, "K1")
    )
    assert sound.predicted(sound.free).variance < 2
    assert found.predicted(found.free).variance > 2.5 * found.noise


def test_of_linear_observations_images_are_predicted_exactly() -> None:
    """What an image adds to the least squares of all others, with a parameter at zero that was estimated."""
    rng = np.random.default_rng(0)
    by, off, values = rng.normal(size=(5, 8, 3)), rng.normal(size=(5, 8)), np.array([0.2, -0.1, 0.3])
    own, side, names = np.swapaxes(by, 1, 2) @ by, np.einsum("nri,nr->ni", by, off), ("a", "b", "c")
    found = Information(
        names, values, names, own.sum(axis=0), side.sum(axis=0), own, side, (off**2).sum(axis=1),
        np.zeros(5), float((off**2).sum()), 40.0, np.zeros(3), 40,
    ).predicted(("a", "b"))  # fmt: skip
    off = off + values[2] * by[:, :, 2]

    def least(images: list[int]) -> tuple[float, Array]:
        x = np.linalg.lstsq(by[images, :, :2].reshape(-1, 2), off[images].ravel(), rcond=None)[0]
        return float(((off[images] - by[images, :, :2] @ x) ** 2).sum()), x

    cost, x = least([0, 1, 2, 3, 4])
    assert found.cost == pytest.approx(cost)
    np.testing.assert_allclose(found.values, [*(values[:2] + x), 0.0], rtol=0, atol=1e-12)
    rest = [least([i for i in range(5) if i != image])[0] for image in range(5)]
    np.testing.assert_allclose(found.squares, cost - np.array(rest), rtol=1e-9)
