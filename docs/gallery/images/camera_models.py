r"""
The same lens in another camera model
=====================================

Every program has its own camera model. A calibration can be converted, but only as well as the other model
can follow: where it cannot, the conversion says how much is lost, and where.
"""

# %%
# A wide lens, calibrated with the equidistant model of fisheye lenses.
import matplotlib.pyplot as plt
import numpy as np

from reseau.core.figures import image_axes
from reseau.optics import PixelGrid, camera_model, convert

grid = PixelGrid(1280, 960, (0.005, 0.005))
fisheye = camera_model("fisheye")
values = {"fx": 620.0, "fy": 620.0, "cx": 639.5, "cy": 479.5, "k1": -0.02, "k2": 0.004}
camera = fisheye.mapping(np.array([values.get(name, 0.0) for name in fisheye.names]), grid, {})

# %%
# Four other models, and the largest difference that is left in the image.
figure, panels = plt.subplots(2, 2, figsize=(8.2, 6.4), layout="constrained")
worst = {}
for axes, (model, free) in zip(
    panels.ravel(),
    {
        "opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "k3"),
        "opencv_full": (),
        "double_sphere": (),
        "omni": (),
    }.items(),
    strict=True,
):
    found = convert(camera, grid, model, free=free)
    worst[model] = found.greatest_px
    columns = np.unique(found.xy[:, 0])
    size = np.hypot(*found.difference.T)
    axes.tripcolor(*found.xy.T, np.maximum(size, 1e-4), norm="log", shading="gouraud", cmap="viridis")
    shown = axes.collections[0]
    shown.set_clim(1e-4, 10.0)
    image_axes(axes, 1280, 960, f"{model}: {found.rms_px:.2g} px rms, {found.greatest_px:.2g} px at most")
    axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
figure.colorbar(shown, ax=panels, label="difference / px", shrink=0.8)

# %%
# A polynomial in the tangent cannot follow a fisheye lens to its corners; a model with a second sphere can.
print({model: f"{px:.3g} px" for model, px in worst.items()})
assert worst["double_sphere"] < worst["opencv"]
