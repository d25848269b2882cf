r"""
Rays through a lens
===================

From the prescription of a lens (curvatures, distances, glasses) rays tell everything that geometry can:
where the pupils are, how large the spot of a point is, and how it changes over the image.
"""

# %%
# A cemented achromat of 100 mm, f/5: two glasses that together bend blue and red light alike.
import matplotlib.pyplot as plt
import numpy as np

from reseau.optics.lenses import (
    AIR,
    Paraxial,
    Prescription,
    PupilElements,
    Tracer,
    aim,
    glass,
    in_order,
)

COLOURS = {486.1: "#2f5d7c", 587.6: "#6f9a3a", 656.3: "#b3402a"}


def achromat(back):
    """The lens with its image surface at a distance behind it."""
    rows = [
        (1 / 61.47, 6.0, glass("N-BK7")),
        (-1 / 44.64, 2.5, glass("N-SF5")),
        (-1 / 129.94, back, AIR),
    ]
    return Prescription(in_order(rows), stop=0, stop_radius=10.0, wavelengths_nm=tuple(COLOURS), reference=1)


lens = achromat(Paraxial(achromat(90.0)).back_focus)
print(f"focal length {Paraxial(lens).focal_length:.1f} mm, f/{Paraxial(lens).f_number:.1f}")
assert abs(Paraxial(lens).focal_length - 100) < 3

# %%
# The lens in section, with rays from far away on the axis and 3° from it.
figure, axes = plt.subplots(figsize=(8.0, 2.6), layout="constrained")
for angle, colour in ((0.0, "#9aa3a8"), (3.0, "#b3402a")):
    away = np.array([0.0, -np.sin(np.deg2rad(angle)), -np.cos(np.deg2rad(angle))])
    points = np.tile(1e5 * away, (7, 1))
    rays = aim(lens, points, np.column_stack([np.zeros(7), np.linspace(-1, 1, 7)])).rays
    traced = Tracer(lens).trace(rays, seen=True)
    z = np.array([surface.vertex[2] for surface in lens.surfaces])
    start = rays.xyz + rays.directions * ((-8 - rays.xyz[:, 2]) / rays.directions[:, 2])[:, None]
    path_y = np.vstack([start[:, 1], traced.seen[:, :, 1]])
    path_z = np.vstack([start[:, 2], traced.seen[:, :, 2] + z[:, None]])
    axes.plot(path_z, path_y, color=colour, linewidth=0.8)
h = np.linspace(-12.5, 12.5, 60)
for surface in lens.surfaces[:-1]:
    axes.plot(surface.vertex[2] + surface.sag(np.zeros(60), h), h, color="#22272b", linewidth=1.2)
axes.axvline(lens.surfaces[-1].vertex[2], color="#22272b", linewidth=1.2)
axes.set(aspect="equal", xlabel="mm", yticks=[])

# %%
# Spots: where the rays of one point meet the image surface, in three colours.
figure, spots = plt.subplots(figsize=(8.0, 3.0), layout="constrained")
elements, sizes = PupilElements.equal_areas(9), {}
for k, angle in enumerate((0.0, 1.5, 3.0)):
    away = 1e5 * np.array([0.0, -np.sin(np.deg2rad(angle)), -np.cos(np.deg2rad(angle))])
    found = [
        Tracer(lens, nm).trace(aim(lens, np.tile(away, (len(elements.xy), 1)), elements.xy, nm).rays).xy
        for nm in COLOURS
    ]
    middle = found[1].mean(axis=0)
    for xy, colour in zip(found, COLOURS.values(), strict=True):
        spots.plot(*((xy - middle) * 1000 + [250 * k, 0]).T, ".", color=colour, markersize=2)
    sizes[angle] = 1000 * float(np.sqrt(((found[1] - middle) ** 2).sum(axis=1).mean()))
    spots.text(250 * k, -105, f"{angle}°: {sizes[angle]:.0f} µm rms", ha="center")
spots.set(aspect="equal", xlim=(-120, 620), ylim=(-120, 110), xticks=[], yticks=[])
spots.set_title("spots in blue, green and red light", loc="left")
print({angle: round(size, 1) for angle, size in sizes.items()})

# %%
# The lens is corrected for colour: blue and red come to focus nearly together, unlike in a single lens.
focus = [Paraxial(lens, nm).back_focus for nm in (486.1, 656.3)]
single = Prescription(in_order([(1 / 51.7, 6.0, glass("N-BK7")), (0.0, 95.0, AIR)]), stop=0, stop_radius=10.0)
alone = [Paraxial(single, nm).back_focus for nm in (486.1, 656.3)]
print(
    f"red comes to focus {focus[1] - focus[0]:.2f} mm behind blue, "
    f"in a single lens {alone[1] - alone[0]:.2f} mm"
)
assert abs(focus[1] - focus[0]) < 0.2 * abs(alone[1] - alone[0])
assert sizes[0.0] < sizes[3.0]
