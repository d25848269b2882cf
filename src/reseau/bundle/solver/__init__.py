"""The solver: normal equations with the points eliminated, iteration, cofactors, datum."""
