"""Sweeps: every run of an experiment file that is missing is trained and evaluated, here or on a cluster."""
