"""The procedures: one module per publication, and what serves them.

`oscilloscope`, `film_frame` and `testfield` implement a publication each. `calibration` calibrates a camera
from images of a target, `sensor` calibrates a sensor. `target_measurement`, `turntable` and `z_stage` serve
them.
"""
