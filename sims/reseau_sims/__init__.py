"""Simulators: what behaves like hardware, drawn from one shared `World`."""
