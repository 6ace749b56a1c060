"""One module per panel. A panel draws what it is given and asks the desk for everything else."""
