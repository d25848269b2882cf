"""From a network to its result: blunders, weights, and the parameters that the observations ask for."""
