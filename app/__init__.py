"""The operators' user interface: a client of the API and nothing else."""
