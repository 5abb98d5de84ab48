"""Small runs of every kind: what differs in the state that a resumed training must have."""

from __future__ import annotations

SMALL = (
    "algo.n_envs=8", "algo.n_steps=16", "algo.batch_size=64", "algo.n_epochs=2", "algo.policy_layers=[16]",
    "algo.value_layers=[16]", "algo.total_steps=3840",
)  # fmt: skip
ROLLOUT = 128  # steps of a rollout of these runs

KINDS = {
    "plain": ("level=none", "curriculum=none", "randomization=none"),
    "curriculum": ("level=1", "curriculum.cost_hold=0.1", "curriculum.cost_ramp=0.9", "env.horizon=1"),
    "eased": (
        "level=1",
        "curriculum.obstacle_ease=0.5",
        "curriculum.waypoint_ease=1",
        "curriculum.ease_end=0.9",
        "env.horizon=1",
    ),
    "buffers": ("level=1", "curriculum.gate_starts=0.3", "curriculum.memory_starts=0.4", "env.horizon=1"),
    "hard": (
        "level=3",
        "curriculum.hard_starts=0.5",
        "curriculum.hard_time=0.2",
        "curriculum.hard_late=true",
        "curriculum.staged_end=0.5",
        "env.horizon=1",
    ),
    "taught": ("level=2", "curriculum.teaching=3", "curriculum.teaching_end=0.6", "env.horizon=1"),
    "escaping": (
        "level=2",
        "curriculum.teaching=3",
        "curriculum.escape_starts=0.1",
        "curriculum.escape_end=0.6",
        "env.horizon=1",
    ),
    "roomy": (
        "level=2",
        "curriculum.room_rate=1e-3",
        "curriculum.room_begin=0.1",
        "curriculum.room_every=2",
        "curriculum.room_time=0.2",
        "curriculum.room_starts=500",
        "curriculum.polish_rounds=2",
        "curriculum.polish_starts=200",
        "curriculum.polish_beginnings=400",
        "env.horizon=1",
    ),
    "std_by_state": ("level=1", "algo.state_dependent_std=true", "env.horizon=1"),
    "mixed": ("level=mixed", "level.maps=5", "observation=rays", "env.horizon=1"),
    "randomized": ("level=2", "randomization=full", "randomization.maps=3", "env.horizon=0.6"),
    "laps": ("env=split_s", "env.horizon=1"),
    "song": ("baseline=song", "level=2", "algo.activation=tanh"),
    "one_epoch": ("level=3", "algo.n_epochs=1", "algo.batch_size=128", "env.horizon=0.4"),
    "deep": ("level=1", "algo.policy_layers=[16,8]", "algo.value_layers=[8,16]", "algo.ent_coef=0.01"),
    "two_threads": ("level=1", "algo.threads=2", "observation=relative"),
}

SHORT = ("level=1", "curriculum.memory_starts=0.4", "env.horizon=0.3", "algo.total_steps=384")  # where many are needed


def words(kind: str, seed: int = 0) -> list[str]:
    """The overrides of a kind."""
    settings = dict(word.split("=", 1) for word in (*SMALL, *(KINDS | {"short": SHORT})[kind]))
    return [*(f"{name}={value}" for name, value in settings.items()), f"seed={seed}"]
