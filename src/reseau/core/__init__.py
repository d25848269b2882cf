"""What every other package stands on: errors, frames, image points, surroundings, provenance, processes."""
