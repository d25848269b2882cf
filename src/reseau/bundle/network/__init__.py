"""The network: cameras, images, points and their observations, in columns."""
