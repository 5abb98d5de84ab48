"""Time-optimal quadrotor flight through clutter by safe reinforcement learning."""

__version__ = "0.1.0"
