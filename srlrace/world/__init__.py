"""Tracks, obstacles, forest levels, and geometric queries on them: no drone, no reward, no files of runs."""
