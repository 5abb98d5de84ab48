"""The time-optimal reference T_ref: how fast the airframe can fly a track. Solving needs the extra ``bound``."""
