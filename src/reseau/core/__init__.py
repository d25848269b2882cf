"""What every other package stands on: errors, frames and image points, provenance, worker processes."""
