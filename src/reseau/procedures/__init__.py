"""One module per published procedure: its steps in its order, nothing else."""
