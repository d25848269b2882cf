"""Drivers: what talks to hardware. The first ones arrive with the instruments they drive."""
