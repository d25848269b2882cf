"""Meid's procedure over a network: blurred targets behind a port, measured by rays, better than before."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.core.executors import Processes
from reseau.core.failure import Code, Failure, Remark
from reseau.io.targets import SpaceTargets
from reseau.optics.lenses import Paraxial, in_order
from reseau.optics.lenses.ray_maps import LensCamera
from reseau.optics.refraction import RefractedRays
from reseau.procedures.blurred import focused, thin_lens_of
from reseau.procedures.blurred_network import (
    BlurredNetwork,
    NetworkOptions,
    _misfits,
    _Run,
    measure_blurred_network,
)

from ..montecarlo import slowly
from . import underwater

LENS_F = abs(Paraxial(underwater.LENS).focal_length)


@cache
def drawn() -> underwater.Project:
    return underwater.project()


@cache
def measured() -> BlurredNetwork:
    project = drawn()
    found = measure_blurred_network(
        project.network, project.frames, project.targets, underwater.CAMERA, NetworkOptions(rounds=2)
    )
    assert isinstance(found, BlurredNetwork)
    return found


@pytest.mark.slow
def test_corresponding_rays_are_measured_where_centroids_are_biased() -> None:
    project, found = drawn(), measured()
    last = found.rounds[found.chosen]
    off = (found.network.xy - project.true[~last.declined])[last.replaced[~last.declined]]
    assert len(off) == 27
    ordinary = project.network.xy - project.true
    assert np.sqrt((ordinary**2).mean()) > 0.08
    assert np.sqrt((off**2).mean()) < 0.02


@pytest.mark.slow
def test_several_processes_measure_the_same() -> None:
    project, options = drawn(), NetworkOptions(rounds=1)
    with Processes(2, ["reseau.procedures.blurred_network"]) as executor:
        found = measure_blurred_network(
            project.network, project.frames, project.targets, underwater.CAMERA, options, executor=executor
        )
    assert isinstance(found, BlurredNetwork)
    one, other = (each.rounds[1].result.network for each in (found, measured()))
    assert one.xy.tobytes() == other.xy.tobytes()
    assert one.cov.tobytes() == other.cov.tobytes()


def test_residuals_and_errors_of_the_points_fall() -> None:
    project, found = drawn(), measured()
    before, after = (entry.result for entry in (found.rounds[0], found.rounds[found.chosen]))
    assert found.rounds[found.chosen].rms_px() < 0.4 * found.rounds[0].rms_px()
    errors = [np.sqrt(np.nanmean((r.points.xyz - project.xyz) ** 2)) for r in (before, after)]
    assert errors[1] < 0.4 * errors[0]
    assert found.chosen > 0


def test_reduced_coordinates_depend_on_the_direction_from_the_projection_centre_alone() -> None:
    """Two points on one ray to the projection centre, near and far, get the same reduced coordinates."""
    project = drawn()
    refraction = project.network.refraction
    assert refraction is not None
    result = measured().rounds[0].result
    run = _Run(project.network, {}, project.targets, underwater.CAMERA, NetworkOptions())
    run.xyz = result.fit.values.xyz
    reduction = run._reduction(result)
    lens, wet = run._camera(result, 0)
    rows = np.flatnonzero((project.network.image_of == 0) & np.isfinite(reduction).all(axis=1))
    values = result.fit.values
    x = (values.xyz[project.network.point_of[rows]] - values.x0[0]) @ values.rotation[0].T
    known = np.isfinite(x).all(axis=1)
    rows, x = rows[known], x[known]
    rays = RefractedRays.of(
        refraction.columns(refraction.values), np.array([0]), np.eye(3)[None], np.zeros((1, 3)), x,
        np.zeros(len(x), np.intp), np.arange(len(x)),
    )  # fmt: skip
    far = 1e6 * np.column_stack([rays.uv, np.ones(len(x))])
    reduced = wet.corresponding(x) - reduction[rows]
    np.testing.assert_allclose(reduced, lens.corresponding(far), rtol=0, atol=1e-8)  # px
    assert np.abs(reduction[rows]).max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("method", [*slowly("centroid"), "edge"])
def test_ordinary_coordinates_can_be_measured(method: Any) -> None:
    project = drawn()
    rough = replace(project.network, xy=np.round(project.true / 4) * 4)
    options = NetworkOptions(rounds=1, initial=method)
    found = measure_blurred_network(rough, project.frames, project.targets, underwater.CAMERA, options)
    assert isinstance(found, BlurredNetwork)
    rows = found.rounds[1].replaced
    ordinary = found.rounds[0].result.network.xy[rows] - project.true[rows]
    assert rows.sum() >= 25
    # The image is where the light is; that is up to 0.6 px beside the corresponding ray.
    assert np.abs(ordinary).max() < 1.0


def test_every_coordinate_is_accounted_for_in_every_round() -> None:
    found = measured()
    for entry in found.rounds:
        counts = entry.replaced.astype(int) + entry.kept + entry.declined
        assert (counts == 1).all()
        assert len(entry.result.network.xy) == int((~entry.declined).sum())


@pytest.mark.parametrize(
    ("off", "initial", "stays"), [(0.02, "given", True), (0.02, "edge", False), (0.5, "given", False)]
)
def test_coordinates_given_by_hand_are_kept_at_sharp_targets_where_they_do_not_differ(
    off: float, initial: Any, stays: bool
) -> None:
    """Their sigmas are 0.05 px, those by rays smaller; 0.5 px is a significant difference."""
    project, last = drawn(), measured().rounds[1]
    found = last.measured["i0"]
    k = int(np.flatnonzero(found.ok)[0])
    sharp = replace(found, blur_px=np.full_like(found.blur_px, 0.5))
    (own,) = np.flatnonzero(
        (project.network.image_of == 0)
        & (project.network.point_of == project.network.points.index(found.ids[k]))
    )
    xy = project.network.xy.copy()
    xy[own] = found.xy[k] + [off, 0.0]
    network = replace(project.network, xy=xy)
    run = _Run(network, {}, project.targets, underwater.CAMERA, NetworkOptions(initial=initial))
    assert run._stays(sharp, k, int(own)) == stays
    assert not run._stays(found, k, int(own))


def test_a_thin_lens_stands_in_for_a_design_that_is_not_known() -> None:
    project = drawn()
    thin = thin_lens_of(project.network.cameras[0], distance=900.0, f_number=LENS_F / 11.0)
    options = NetworkOptions(rounds=1)
    found = measure_blurred_network(project.network, project.frames, project.targets, thin, options)
    assert isinstance(found, BlurredNetwork)
    last = found.rounds[1]
    # The images of this lens have so much coma that some are not like those of a thin one.
    assert last.replaced.sum() >= 15
    assert any("thin lens stands in" in note.text for note in found.notes)
    # Its sigmas contain what it does not know.
    rows = last.replaced[~last.declined]
    off = (found.network.xy - project.true[~last.declined])[rows]
    over = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.network.cov[rows]), off) / 2
    assert np.sqrt(over.mean()) < 1.5


def test_images_without_a_photograph_keep_their_coordinates() -> None:
    """Here only one photograph is given: the images without one keep theirs."""
    project = drawn()
    true = replace(project.network, xy=project.true)
    found = measure_blurred_network(
        true, {"i0": project.frames["i0"]}, project.targets, underwater.CAMERA, NetworkOptions(rounds=1)
    )
    assert isinstance(found, BlurredNetwork)
    assert "no photograph of i1, i2" in found.notes[0].text
    last = found.rounds[1]
    off = (found.network.xy - project.true[~last.declined])[last.kept[~last.declined]]
    assert len(off) > 15
    # They are only reduced to the projection centre.
    assert np.abs(off).max() < 1e-3


def test_targets_whose_blurred_images_touch_are_left_out_and_named() -> None:
    found = measured()
    last = found.rounds[-1]
    text = "2 blurred targets were not measured and are left out: t2 in i0, t5 in i0"
    assert any(text in note.text for note in found.notes)
    assert last.measured["i0"].why[2] == "its image touches that of t5"


def test_the_right_lens_has_no_note() -> None:
    assert not any(note.code == "inconsistent" for note in measured().notes)


@pytest.mark.slow
def test_a_stop_that_is_not_that_of_the_photographs_is_found_in_their_images() -> None:
    """It is stated narrower by a third."""
    project = drawn()
    assert all(abs(each.misfit - 1) < 0.2 for each in measured().rounds[1].measured.values())
    narrow = replace(underwater.CAMERA, lens=replace(underwater.LENS, stop_radius=3.5))
    options = NetworkOptions(rounds=2)
    found = measure_blurred_network(project.network, project.frames, project.targets, narrow, options)
    assert isinstance(found, BlurredNetwork)
    said = [note.text for note in found.notes if "the stop was estimated" in note.text]
    assert [text[:2] for text in said] == ["i0", "i1", "i2"]
    percent = [float(text.split("its radius is ")[1].split()[0]) for text in said]
    np.testing.assert_allclose(percent, 100 * (5.5 / 3.5 - 1), rtol=0, atol=0.3)  # three times ± 0.1
    last = found.rounds[found.chosen]
    off = (found.network.xy - project.true[~last.declined])[last.replaced[~last.declined]]
    assert np.sqrt((off**2).mean()) < 0.02


def test_photographs_that_are_not_those_of_the_lens_are_named() -> None:
    entry = measured().rounds[1]
    note = (Remark("lens, focus or aperture are not those of the photograph", Code.INCONSISTENT),)
    unlike = {
        name: replace(found, notes=note * (name != "i1"), uneven=name == "i2")
        for name, found in entry.measured.items()
    }
    by_residuals, by_widths = _misfits(replace(entry, measured=unlike))
    assert by_residuals.text.startswith("residuals of the targets in i0 are ")
    assert by_widths.text.startswith("what blurs beside the rays differs from target to target in i2: lens")


@pytest.mark.slow
def test_a_lens_that_images_no_target_as_it_is_fails_with_the_reason() -> None:
    """The front element alone."""
    project = drawn()
    rows = [underwater.ROWS[0], (-0.006, 4.5, underwater.AIR), underwater.ROWS[3]]
    lens = focused(replace(underwater.LENS, surfaces=in_order(rows), stop=2), 900.0)
    camera = LensCamera(lens, underwater.CAMERA.sensor)
    options = NetworkOptions(rounds=1)
    found = measure_blurred_network(project.network, project.frames, project.targets, camera, options)
    assert isinstance(found, Failure)
    assert "28 of 29 targets were not measured by rays, most often: nothing like its image" in found.reason


def test_a_network_in_an_unknown_unit_and_a_camera_without_lens_are_refused() -> None:
    project = drawn()
    with pytest.raises(UsageError, match="mm"):
        measure_blurred_network(replace(project.network, unit="inch"), {}, project.targets, underwater.CAMERA)
    with pytest.raises(UsageError, match="has no lens"):
        measure_blurred_network(project.network, {}, project.targets, {})


def test_without_any_photograph_nothing_is_measured() -> None:
    project = drawn()
    found = measure_blurred_network(project.network, {}, project.targets, underwater.CAMERA)
    assert isinstance(found, Failure)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"size": [0.0] * 12}, "size"),
        ({"normal": [[0.0, 0.0, 0.0]] * 12}, "normal is zero"),
        ({"id": ["t"] * 12}, "duplicate id"),
        ({"shape": ["cone"] * 12}, "shape"),
        ({"size": [1.0]}, "1 entries"),
        ({"side": [[0.0, 0.0, 1.0]] * 12, "normal": [[0.0, 0.0, 1.0]] * 12}, "direction of its normal"),
    ],
)
def test_what_are_no_targets_is_refused_in_one_line(change: dict[str, Any], words: str) -> None:
    content = json.loads(drawn().targets.to_json())
    content["targets"] |= change
    with pytest.raises(Exception, match=words) as error:
        SpaceTargets.parse(json.dumps(content), where="targets.json")
    assert "\n" not in str(error.value)


def test_a_camera_that_cannot_follow_the_lens_is_named() -> None:
    """With one radial coefficient, the distortion of the design is left by more than the sigmas."""
    project = drawn()
    camera = project.network.cameras[0]
    run = _Run(project.network, {}, project.targets, underwater.CAMERA, NetworkOptions())
    result = measured().result
    assert run._unfollowed(result) == ()
    cov = np.full_like(result.network.cov, 0.0) + 1e-4**2 * np.eye(2)
    sure = replace(result, network=replace(result.network, cov=cov))
    few = replace(project.network, cameras=(replace(camera, free=("c",)),))
    (note,) = _Run(few, {}, project.targets, underwater.CAMERA, NetworkOptions())._unfollowed(sure)
    assert note.code == "unmodelled"
    assert "(c) follow the distortion" in note.text
