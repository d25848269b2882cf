"""The procedures: one module per publication, and what serves them.

`oscilloscope`, `film_frame` and `testfield` implement a publication each. `calibration` calibrates a camera
from images of a target, with the options of `calibration_options` and the result of `calibrated`; `sensor`
calibrates a sensor. `target_measurement`, `turntable` and `z_stage` serve them.
"""
