"""Drivers of oscilloscopes, cameras, ultrasonic scanners and turntables, and codecs of their protocols."""
