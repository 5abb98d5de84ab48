"""Time-optimal quadrotor flight through clutter by safe reinforcement learning."""

import sys

__version__ = "0.1.0"

if "gymnasium" in sys.modules:  # whoever uses Gymnasium finds the race there; nobody else pays for importing it
    from srlrace.task.registration import register

    register()
