"""The names under which Gymnasium knows the race; light, so that ``import srlrace`` can afford it.

``import gymnasium, srlrace`` registers them, in this order: srlrace does not import Gymnasium by itself.
``import srlrace.task.gym_env`` registers them whatever was imported before.
"""

from __future__ import annotations

import gymnasium

ENVIRONMENTS = {"srlrace/Forest-v0": "forest", "srlrace/SplitS-v0": "split_s"}


def register() -> None:
    """Register the environments with Gymnasium, once."""
    for name, track in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="srlrace.task.gym_env:DroneRaceEnv",
                vector_entry_point="srlrace.task.gym_env:DroneRaceVectorEnv",
                kwargs={"track": track},
            )
