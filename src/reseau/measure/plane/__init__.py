"""Mappings of a plane to the image: projectivity, fisheye, and a polynomial or a lens."""
