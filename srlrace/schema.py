"""The typed schema: every setting of a run, with its unit, its range and its meaning.

Frozen dataclasses and nothing else; `srlrace.config` turns plain data into them. This module knows
nothing of Hydra, numpy or torch, so a stored ``config.json`` can be checked without importing any.
"""

# ruff: noqa: RUF009  (`setting` is this module's `dataclasses.field`)

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from typing import Any

Vec3 = tuple[float, float, float]

# What to evaluate a policy on: its training maps, these again from other starts, unseen ones of the same level, and of
# levels 1 to 3.
SUITES = ("train_map", "validation", "unseen", "level1", "level2", "level3")
# First word of every stream of starts: of the tables, and of the suite that settings are chosen by. Ours, arbitrary;
# no training may have them.
EVALUATION_SEED = 20_240_401
VALIDATION_SEED = 777_001

FAR = 10_000.0  # m: no coordinate beyond this; metres stay exact to 1 mm in single precision


def setting(
    meaning: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] = (),
    least: int = 0,
    most: int = 100,
    optional: bool = False,
    default: Any = MISSING,
) -> Any:
    """Declare one setting: what it means, its unit, and the values it takes.

    ``low`` and ``high`` are inclusive bounds, ``above`` an exclusive lower bound; they apply to each
    element of a tuple. ``least`` and ``most`` bound the length of a tuple that has no fixed length.
    A text without ``choices`` is a name; an ``optional`` one may be empty.
    """
    bounds = {"low": low, "high": high, "above": above, "least": least, "most": most}
    metadata = {"meaning": meaning, "unit": unit, "choices": choices, "optional": optional, **bounds}
    return field(metadata=metadata) if default is MISSING else field(default=default, metadata=metadata)


@dataclass(frozen=True)
class ObstacleConfig:
    """One obstacle as the track's author describes it; `srlrace.world` turns it into spheres."""

    kind: str = setting("shape", choices=("sphere", "cylinder", "box"))
    center: Vec3 = setting("centre of the shape, world frame", unit="m", low=-FAR, high=FAR)
    radius: float = setting("radius of a sphere or an upright cylinder", unit="m", low=0.0, high=1000.0, default=0.0)
    height: float = setting("height of a cylinder", unit="m", low=0.0, high=1000.0, default=0.0)
    edge: float = setting("edge of an axis-aligned cube", unit="m", low=0.0, high=1000.0, default=0.0)


@dataclass(frozen=True)
class TrackConfig:
    """A course of waypoints inside a box-shaped world."""

    name: str = setting("name of the track, part of the run id")
    waypoints: tuple[Vec3, ...] = setting(
        "waypoints in the order of passing, world frame", unit="m", low=-FAR, high=FAR, least=1, most=1000
    )
    start: Vec3 = setting("nominal start position, world frame", unit="m", low=-FAR, high=FAR)
    bounds_low: Vec3 = setting("lower corner of the world", unit="m", low=-FAR, high=FAR)
    bounds_high: Vec3 = setting("upper corner of the world", unit="m", low=-FAR, high=FAR)
    laps: int = setting(
        "0: a course that ends at the last waypoint; k: k timed laps, ends at the first one", low=0, high=1000
    )
    horizon: float = setting("time limit of an episode", unit="s", above=0.0, high=600.0)
    passing_radius: float = setting("a waypoint is passed within this distance", unit="m", above=0.0, default=0.3)
    displaced_waypoints: int = setting(
        "waypoints displaced per episode when displacement is on", low=0, high=1000, default=0
    )
    obstacles: tuple[ObstacleConfig, ...] = setting("obstacles that belong to the track", most=10_000, default=())


@dataclass(frozen=True)
class SpacingConfig:
    """One density of forest: trees on a square lattice, each jittered within a disc."""

    pitch: float = setting("distance between lattice neighbours", unit="m", low=1.0, high=FAR)
    jitter: float = setting("radius of each tree's random offset", unit="m", low=0.0, high=FAR)


@dataclass(frozen=True)
class LevelConfig:
    """The clutter of a track: which obstacles stand in it, and when the drone touches one."""

    name: str = setting("name of the obstacle level")
    spacings: tuple[SpacingConfig, ...] = setting("densities of the generated maps, used in turn", default=())
    maps: int = setting("number of generated maps", low=1, high=10_000, default=1)
    map_seed: int = setting("seed of the first map; map i is drawn from map_seed + i", low=0, high=2**31 - 1, default=0)
    tree_radius: float = setting("radius of a tree", unit="m", above=0.0, high=100.0, default=0.3)
    clear_radius: float = setting(
        "no tree surface closer to a waypoint or the start", unit="m", low=0.0, high=100.0, default=1.0
    )
    fresh_steps: int = setting(
        "training replaces one map by a new draw every so many environment steps; 0: never",
        low=0, high=10**12, default=0,
    )  # fmt: skip
    safety_margin: float = setting("epsilon of d_safe = r + l + epsilon", unit="m", low=0.0, high=10.0, default=0.1)
    obstacles: tuple[ObstacleConfig, ...] = setting("fixed obstacles, in every map", most=10_000, default=())


@dataclass(frozen=True)
class RewardConfig:
    """The weight of each reward term; zero switches a term off."""

    name: str = setting("name of the reward preset")
    progress: float = setting("weight of the metres gained towards the target (lambda 1)", unit="1/m")
    body_rate: float = setting("weight of the body rate's norm (minus lambda 2)", unit="s/rad")
    safety: float = setting("weight of sum exp(-distance in m) over the nearest obstacles (lambda 3)")
    collision: float = setting("given once on a crash or on leaving the world (r_c)")
    completion: float = setting("given once on completion", default=0.0)
    completion_time: float = setting("weight of the total time, given once on completion", unit="1/s", default=0.0)
    time: float = setting("weight of the time that passes, given at every step", unit="1/s", default=0.0)


BLOCKS = (
    "position",
    "rotation",
    "velocity",
    "body_rate",
    "targets",
    "obstacle_distances",
    "obstacle_vectors",
    "rays",
    "height",
)


@dataclass(frozen=True)
class ObservationConfig:
    """What the policy sees: named blocks, concatenated in order."""

    name: str = setting("name of the observation preset")
    blocks: tuple[str, ...] = setting("blocks in order", least=1, most=len(BLOCKS), choices=BLOCKS)
    targets: int = setting("waypoints seen ahead (j)", low=1, high=8, default=2)
    obstacles: int = setting("nearest obstacles seen and counted by the safety reward (N)", low=1, high=64, default=10)
    range: float = setting("obstacles farther than this are not seen", unit="m", above=0.0, high=100.0, default=10.0)
    rays: int = setting("horizontal rays around the drone", low=4, high=256, default=32)
    ray_scale: float = setting("a ray of length d is seen as exp(-d / ray_scale)", unit="m", above=0.0, default=2.5)
    ray_focus: float = setting(
        "rays are denser ahead: an angle of pi u becomes pi u^this; 1 is evenly spaced", low=1.0, high=4.0, default=1.0
    )
    ray_walls: bool = setting("rays end at the world's walls, too", default=False)
    frame: str = setting(
        "horizontal axes of what is seen: the world's, or x towards the next waypoint",
        choices=("world", "target"),
        default="world",
    )


@dataclass(frozen=True)
class QuadConfig:
    """The airframe, its rotors and its low-level rate controller."""

    name: str = setting("name of the quadrotor preset")
    mass: float = setting("mass", unit="kg", above=0.0)
    inertia: Vec3 = setting("principal moments of inertia", unit="kg m^2", above=0.0)
    arm_length: float = setting("rotor to centre; also the radius of the drone for collisions", unit="m", above=0.0)
    torque_constant: float = setting("rotor torque per thrust (kappa)", unit="m", above=0.0)
    thrust_max: float = setting("largest thrust of one rotor", unit="N", above=0.0)
    rotor_time_constant: float = setting("first-order lag of the rotor thrust", unit="s", above=0.0)
    body_rate_max: Vec3 = setting("largest commanded body rates", unit="rad/s", above=0.0)
    rate_gains: Vec3 = setting("proportional gains of the rate controller", unit="1/s", above=0.0)
    drag: Vec3 = setting("linear drag along the body axes", unit="1/s, or kg/s with drag_model=force", low=0.0)
    drag_model: str = setting("what the drag coefficients multiply to", choices=("acceleration", "force"))


@dataclass(frozen=True)
class SimConfig:
    """Time stepping."""

    control_period: float = setting("time between two actions", unit="s", low=0.001, high=0.2, default=0.02)
    substeps: int = setting("RK4 steps per control period", low=1, high=256, default=8)


@dataclass(frozen=True)
class RandomizationConfig:
    """What is drawn anew at each reset."""

    name: str = setting("name of the randomization preset")
    position: float = setting("start position: +- this per axis", unit="m", low=0.0)
    velocity: float = setting("start velocity: +- this per axis", unit="m/s", low=0.0)
    attitude: float = setting("roll, pitch, yaw (or quaternion components): +- this", unit="rad", low=0.0)
    attitude_draw: str = setting("how the attitude is drawn", choices=("euler", "quaternion"), default="euler")
    min_height: float = setting("lowest start and waypoint height above the floor", unit="m", low=0.0, default=0.3)
    waypoint_displacement: float = setting("displaced waypoints: +- this per axis", unit="m", low=0.0, default=0.0)
    every_waypoint: bool = setting("displace every waypoint, not only as many as the track says", default=False)
    maps: int = setting("draw from at least this many maps", low=1, high=10_000, default=1)
    drag: float = setting("drag: +- this fraction", low=0.0, high=1.0, default=0.0)
    thrust: float = setting("thrust map: +- this fraction", low=0.0, high=0.9, default=0.0)


@dataclass(frozen=True)
class CurriculumConfig:
    """How training starts easier than evaluation; evaluation never uses any of this."""

    name: str = setting("name of the curriculum preset")
    gate_starts: float = setting("share of resets near a random waypoint instead of the start", low=0.0, high=1.0)
    memory_starts: float = setting("share of resets from a remembered passing of a waypoint", low=0.0, high=1.0)
    retry_starts: float = setting("share of resets from the start of an earlier episode that failed", low=0.0, high=1.0)
    memory_size: int = setting("remembered passings per waypoint, and failed starts", low=1, high=100_000)
    staged_hold: float = setting("share of training during which gate and memory starts keep theirs", low=0.0, high=1.0)
    staged_end: float = setting("share of training after which there are none, reached linearly", low=0.0, high=1.0)
    cost_initial: float = setting("share of every cost (negative weight) at the first step", low=0.0, high=1.0)
    cost_hold: float = setting("share of training during which it stays there", low=0.0, high=1.0)
    cost_ramp: float = setting("share of training after which it is 1, reached linearly", low=0.0, high=1.0)
    obstacle_ease: float = setting("obstacles are smaller by this at first", unit="m", low=0.0, high=100.0, default=0.0)
    waypoint_ease: float = setting("waypoints are larger by this at first", unit="m", low=0.0, high=100.0, default=0.0)
    ease_hold: float = setting("share of training during which both keep that", low=0.0, high=1.0, default=0.0)
    ease_end: float = setting("share of training after which both are true to size", low=0.0, high=1.0, default=0.0)
    obstacle_margin: float = setting(
        "obstacles are larger and walls nearer by this throughout training", unit="m", low=0.0, high=100.0, default=0.0
    )
    obstacle_margin_after: float = setting(
        "but in the first part of an episode, so long, they are not", unit="s", low=0.0, high=600.0, default=0.0
    )
    waypoint_margin: float = setting(
        "waypoints are smaller by this throughout training", unit="m", low=0.0, high=100.0, default=0.0
    )
    start_margin: float = setting(
        "ranges of starts are wider by this share throughout training", low=0.0, high=10.0, default=0.0
    )
    hard_starts: float = setting(
        "share of resets from where a flight was two passings before it crashed", low=0.0, high=1.0, default=0.0
    )
    hard_time: float = setting(
        "flights from such a place end after this time; 0: like any other", unit="s", low=0.0, high=600.0, default=0.0
    )
    hard_begin: float = setting(
        "share of training before which there are none of these", low=0.0, high=1.0, default=0.0
    )
    hard_late: bool = setting("a flight that is not over in time counts as crashed for these", default=False)
    teaching: float = setting(
        "weight, at first, of doing as a demonstrated flight does (srlrace bound --demonstrate); 0: none is shown",
        low=0.0, high=1000.0, default=0.0,
    )  # fmt: skip
    teaching_end: float = setting(
        "share of training after which that weight is 0, reached linearly", low=0.0, high=1.0, default=0.0
    )
    escape_starts: float = setting(
        "share of resets from hard starts whose ways out are shown, too (srlrace bound --escapes)",
        low=0.0, high=1.0, default=0.0,
    )  # fmt: skip
    escape_hold: float = setting(
        "share of training during which these count as much as the flight at first", low=0.0, high=1.0, default=0.0
    )
    escape_end: float = setting(
        "share of training after which they count nothing, reached linearly", low=0.0, high=1.0, default=0.0
    )
    room_rate: float = setting(
        "step size, at first, of steps towards more room where flights come close, by a gradient through the "
        "simulator; 0: none",
        low=0.0, high=1.0, default=0.0,
    )  # fmt: skip
    room_begin: float = setting("share of training before which there are none", low=0.0, high=1.0, default=0.0)
    room_end: float = setting("share of training after which there are none", low=0.0, high=1.0, default=1.0)
    room_every: int = setting("rollouts from one such step to the next", low=1, high=10**6, default=1)
    room_starts: int = setting(
        "flights that are searched for such places, besides those from starts with a known way out",
        low=1, high=1_000_000, default=6000,
    )  # fmt: skip
    room_time: float = setting(
        "what is flown for a step: so long up to where a flight comes closest",
        unit="s", above=0.0, high=10.0, default=1.2,
    )  # fmt: skip
    room_wanted: float = setting(
        "room that is enough: so much closer a drone may come before it is a crash",
        unit="m", low=0.0, high=100.0, default=0.1,
    )  # fmt: skip
    polish_rounds: int = setting(
        "rounds, after all steps, of natural-gradient steps towards less time and more room, by gradients through the "
        "simulator; 0: none",
        low=0, high=10_000, default=0,
    )  # fmt: skip
    polish_starts: int = setting("whole flights that each round looks at first", low=1, high=1_000_000, default=20_000)
    polish_beginnings: int = setting(
        "and the beginnings of so many others, for starts that are dangerous themselves",
        low=0, high=10_000_000, default=0,
    )  # fmt: skip
    polish_time: float = setting(
        "how much a step towards less time changes actions at first, root mean square of their norm; in the last "
        "third there is none",
        low=0.0, high=1.0, default=0.001,
    )  # fmt: skip
    polish_room: float = setting(
        "how much a step towards more room changes actions, root mean square of their norm; in the last third it "
        "becomes less",
        low=0.0, high=1.0, default=0.003,
    )  # fmt: skip
    polish_wanted: float = setting(
        "room that is enough: so much closer a drone may come before it is a crash",
        unit="m", low=0.0, high=100.0, default=0.04,
    )  # fmt: skip
    polish_inside: float = setting(
        "and so far inside its sphere a waypoint is to be passed", unit="m", low=0.0, high=100.0, default=0.02
    )
    polish_hopeless: float = setting(
        "who gets deeper into an obstacle, or beyond a wall, is not helped", unit="m", low=0.0, high=100.0, default=0.25
    )


@dataclass(frozen=True)
class AlgoConfig:
    """PPO and its budget."""

    name: str = setting("name of the algorithm preset")
    total_steps: int = setting("environment steps of the whole training", low=1, high=10**12)
    n_envs: int = setting("parallel drones", low=1, high=10**9)
    n_steps: int = setting("steps per drone in a rollout", low=2, high=10**6)
    batch_size: int = setting("samples in a minibatch", low=2, high=10**9)
    n_epochs: int = setting("passes over a rollout", low=1, high=1000)
    learning_rate: float = setting("Adam's step size at the start", above=0.0, high=1.0)
    learning_rate_final: float = setting("Adam's step size at the end", low=0.0, high=1.0)
    gamma: float = setting("discount per step", above=0.0, high=1.0)
    gae_lambda: float = setting("GAE's lambda", low=0.0, high=1.0)
    clip_range: float = setting("PPO's clip range", above=0.0, high=10.0)
    ent_coef: float = setting("weight of the entropy bonus", low=0.0)
    vf_coef: float = setting("weight of the value loss", low=0.0)
    max_grad_norm: float = setting("gradients are clipped to this norm", above=0.0)
    reward_scale: float = setting("rewards are multiplied by this for learning, not in what is logged", above=0.0)
    log_std_init: float = setting("initial log standard deviation of the actions", low=-10.0, high=5.0)
    policy_layers: tuple[int, ...] = setting("hidden layers of the policy", low=1, high=8192, least=1, most=16)
    value_layers: tuple[int, ...] = setting("hidden layers of the value function", low=1, high=8192, least=1, most=16)
    activation: str = setting("activation of the hidden layers", choices=("relu", "tanh", "elu"))
    noise_correlation: float = setting(
        "correlation of the exploration noise from step to step; 0: white noise", low=0.0, high=0.999, default=0.0
    )
    state_dependent_std: bool = setting(
        "the standard deviation of the actions depends on the state: a second half of the policy's outputs",
        default=False,
    )
    averaged: float = setting(
        "share of the training, at its end, whose weights are averaged; 0: the last ones alone",
        low=0.0, high=1.0, default=0.0,
    )  # fmt: skip
    learning_rate_hold: float = setting(
        "share of the training during which Adam's step size stays as at the start", low=0.0, high=0.99, default=0.0
    )
    learning_rate_decay: str = setting(
        "how it falls from then on: by equal differences or by equal ratios",
        choices=("linear", "geometric"), default="linear",
    )  # fmt: skip
    threads: int = setting("torch threads, pinned", low=1, high=256, default=1)


@dataclass(frozen=True)
class DisturbanceConfig:
    """How the world of an evaluation differs from the nominal one, which policy and rate controller believe in."""

    name: str = setting("name of the disturbance, part of the suite's name")
    mass: float = setting(
        "mass, as a multiple of the nominal one; the inertia stays", above=0.0, high=10.0, default=1.0
    )
    drag: float = setting("drag force, as a multiple of the nominal one", low=0.0, high=10.0, default=1.0)
    thrust: float = setting("what rotors deliver, as a multiple of what is asked", above=0.0, high=10.0, default=1.0)
    delay: float = setting(
        "an action takes effect this much later; whole control periods", unit="s", low=0.0, high=1.0, default=0.0
    )
    position_noise: float = setting(
        "standard deviation of the estimated position, per axis", unit="m", low=0.0, high=10.0, default=0.0
    )
    velocity_noise: float = setting(
        "standard deviation of the estimated velocity, per axis", unit="m/s", low=0.0, high=10.0, default=0.0
    )
    attitude_noise: float = setting(
        "standard deviation of the estimated attitude, per body axis", unit="rad", low=0.0, high=1.0, default=0.0
    )
    noise_time: float = setting(
        "time over which errors of the estimate stay alike (1/e); 0: new at each step",
        unit="s", low=0.0, high=1000.0, default=0.0,
    )  # fmt: skip
    wind: float = setting(
        "steady horizontal wind, from a direction drawn per episode", unit="m/s", low=0.0, high=100.0, default=0.0
    )


@dataclass(frozen=True, kw_only=True)
class Config:
    """One run, completely: the same Config gives the same run."""

    seed: int = setting("seed of everything random in training", low=0, high=2**31 - 1)
    name: str = setting("your own label, replaces the method in the run id", optional=True, default="")
    baseline: str = setting("name of the baseline preset, or none", default="none")
    env: TrackConfig = setting("the track")
    level: LevelConfig = setting("its obstacles")
    reward: RewardConfig = setting("the reward")
    observation: ObservationConfig = setting("the observation")
    quad: QuadConfig = setting("the quadrotor")
    sim: SimConfig = setting("the simulator's time stepping")
    randomization: RandomizationConfig = setting("what resets draw anew")
    curriculum: CurriculumConfig = setting("what makes the start of training easier")
    algo: AlgoConfig = setting("the learning algorithm")

    @property
    def keep_out(self) -> float:
        """How far from an obstacle's surface the drone's centre must stay, m: arm length and safety margin."""
        return self.quad.arm_length + self.level.safety_margin
