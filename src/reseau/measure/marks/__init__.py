"""What the measurement of all marks has in common: their judgement, and the columns of results."""
