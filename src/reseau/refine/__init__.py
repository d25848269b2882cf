"""From one frame to refined image coordinates."""
