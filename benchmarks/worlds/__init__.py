"""Worlds that share nothing with the simulators or with the formation of images in `reseau.optics`.

A measurement that agrees with its own simulator shows that the two agree. These programs draw the same kinds
of frames with another geometry and another formation of pixels: distance fields sampled several times per
pixel, and a blur by the transfer function of point-spread function and pixel. They need numpy, scipy and, to
write files, OpenCV; nothing of the project.
"""
