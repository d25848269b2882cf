"""Loads the compiled loops of a session for processes that are forked later, each of which may be killed."""

from reseau.designs import coded_testfield
from reseau.measure import measure_testfield
from reseau_sims import FieldBench, Station

assert measure_testfield(FieldBench(seed=3).record(Station(30.0, 45.0, 45.0)), coded_testfield())
