"""Tracks, obstacles, level generators and the geometric queries of the race. Knows no drone, no reward, no I/O of runs."""
