"""How a network is adjusted: normal equations with the points eliminated, iteration, cofactors, datum."""
