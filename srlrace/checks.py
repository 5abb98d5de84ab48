"""Checks that involve more than one setting."""

from __future__ import annotations

from srlrace.parse import ConfigError
from srlrace.schema import (
    EVALUATION_SEED,
    VALIDATION_SEED,
    AlgoConfig,
    Config,
    CurriculumConfig,
    LevelConfig,
    ObservationConfig,
    ObstacleConfig,
    TrackConfig,
)

GRAVITY = 9.81  # m/s^2
MEMORY_LIMIT = 64 * 2**30  # bytes: ours, far above what any preset needs (0.02 GiB)

SHAPE_FIELDS = {"sphere": ("radius",), "cylinder": ("radius", "height"), "box": ("edge",)}


def check(config: Config) -> None:
    """Refuse a configuration whose settings contradict one another; raises `ConfigError`."""
    if config.seed in (EVALUATION_SEED, VALIDATION_SEED):
        raise ConfigError(f"seed: got {config.seed}, which draws the starts of evaluations; takes another")
    _check_track(config.env)
    for path, obstacles in (("env", config.env.obstacles), ("level", config.level.obstacles)):
        for index, obstacle in enumerate(obstacles):
            _check_obstacle(f"{path}.obstacles[{index}]", obstacle)
    _check_level(config.level)
    _check_observation(config.observation)
    _check_lift(config)
    _check_batch(config)
    _check_learning_rate(config.algo)
    _check_curriculum(config.curriculum)
    for name in ("waypoint_margin", "polish_inside"):
        value, radius = getattr(config.curriculum, name), config.env.passing_radius
        if value >= radius:
            raise ConfigError(f"curriculum.{name}: got {value:g}; takes less than env.passing_radius, {radius:g}")
    if config.curriculum.teaching > 0.0:
        check_single_map(config, "curriculum.teaching")
    for name in ("room_rate", "polish_rounds"):
        if getattr(config.curriculum, name) > 0 and config.level.fresh_steps:
            raise ConfigError(f"curriculum.{name}: takes 0 with level.fresh_steps, whose maps come and go")
    if config.curriculum.polish_rounds > 0 and config.algo.averaged > 0.0:
        raise ConfigError("curriculum.polish_rounds: takes 0 with algo.averaged, which leaves another policy behind")
    check_memory(config, MEMORY_LIMIT)


def _check_curriculum(curriculum: CurriculumConfig) -> None:
    lasting = ("retry_starts", "escape_starts")
    for names in (("gate_starts", "memory_starts", *lasting), ("hard_starts", *lasting)):  # the latter come as those go
        total = sum(getattr(curriculum, name) for name in names)
        if total > 1.0:
            first, *others, last = (f"curriculum.{name}" for name in names)
            raise ConfigError(f"{first}: with {', '.join(others)} and {last} it makes {total:g}; takes at most 1")
    if curriculum.escape_starts > 0.0 and curriculum.teaching == 0.0:
        raise ConfigError(
            "curriculum.escape_starts: takes 0 while curriculum.teaching is 0, which is how much they count"
        )
    ramps = ("cost_hold", "cost_ramp"), ("staged_hold", "staged_end"), ("ease_hold", "ease_end")
    for first, last in (*ramps, ("escape_hold", "escape_end"), ("room_begin", "room_end")):
        begin, end = getattr(curriculum, first), getattr(curriculum, last)
        if begin > end:
            raise ConfigError(f"curriculum.{first}: got {begin:g}; takes at most curriculum.{last}, which is {end:g}")


def check_single_map(config: Config, what: str) -> None:
    """Refuse several maps for ``what``, which has to do with a flight through one; raises `ConfigError`."""
    maps = max(config.level.maps, config.randomization.maps)
    if maps > 1:
        raise ConfigError(f"{what}: there are {maps} maps; takes a single one, through which the flight leads")


def _check_track(track: TrackConfig) -> None:
    for axis, low, high in zip("xyz", track.bounds_low, track.bounds_high, strict=True):
        if low >= high:
            raise ConfigError(f"env.bounds_low: {axis} is {low:g}; takes less than env.bounds_high, which is {high:g}")
    places = {f"env.waypoints[{i}]": point for i, point in enumerate(track.waypoints)} | {"env.start": track.start}
    for path, point in places.items():
        for axis, low, value, high in zip("xyz", track.bounds_low, point, track.bounds_high, strict=True):
            if not low <= value <= high:
                raise ConfigError(f"{path}: {axis} is {value:g}, outside the world; takes {low:g} to {high:g} [m]")
    if track.displaced_waypoints > len(track.waypoints):
        count = len(track.waypoints)
        raise ConfigError(f"env.displaced_waypoints: got {track.displaced_waypoints}; the track has {count} waypoints")


def _check_obstacle(path: str, obstacle: ObstacleConfig) -> None:
    needed = SHAPE_FIELDS[obstacle.kind]
    for name in ("radius", "height", "edge"):
        value = getattr(obstacle, name)
        if name in needed and value <= 0:
            raise ConfigError(f"{path}.{name}: got {value:g}; a {obstacle.kind} takes a number > 0 [m]")
        if name not in needed and value:
            raise ConfigError(f"{path}.{name}: a {obstacle.kind} has none; it takes {' and '.join(needed)}")


def _check_level(level: LevelConfig) -> None:
    if level.fresh_steps and not level.spacings:
        raise ConfigError(f"level.fresh_steps: got {level.fresh_steps}; level {level.name} draws no maps, takes 0")
    for index, spacing in enumerate(level.spacings):
        if 2 * spacing.jitter >= spacing.pitch:
            raise ConfigError(
                f"level.spacings[{index}].jitter: got {spacing.jitter:g}; takes less than half the pitch"
                f" {spacing.pitch:g}, so that trees keep apart"
            )


def _check_observation(observation: ObservationConfig) -> None:
    for block in observation.blocks:
        if observation.blocks.count(block) > 1:
            raise ConfigError(f"observation.blocks: {block} stands twice; each block takes one place")


def _check_lift(config: Config) -> None:
    lift, weight = 4 * config.quad.thrust_max * (1 - config.randomization.thrust), config.quad.mass * GRAVITY
    if lift <= weight:
        raise ConfigError(f"quad.thrust_max: four rotors lift {lift:.3g} N, the quadrotor weighs {weight:.3g} N")


def _check_batch(config: Config) -> None:
    """A remainder would make one small, noisy minibatch in each epoch."""
    algo = config.algo
    rollout = algo.n_envs * algo.n_steps
    if rollout % algo.batch_size:
        fits = _nearest_divisor(rollout, algo.batch_size)
        raise ConfigError(
            f"algo.batch_size: got {algo.batch_size}; takes a divisor of the rollout,"
            f" n_envs x n_steps = {algo.n_envs} x {algo.n_steps} = {rollout}; nearest: {fits}"
        )


def _check_learning_rate(algo: AlgoConfig) -> None:
    if algo.learning_rate_decay == "geometric" and algo.learning_rate_final == 0.0:
        raise ConfigError("algo.learning_rate_final: got 0; with algo.learning_rate_decay=geometric takes a number > 0")


def _nearest_divisor(number: int, wanted: int) -> int:
    small = [i for i in range(1, min(int(number**0.5), 10**6) + 1) if number % i == 0]
    return min((d for i in small for d in (i, number // i) if d > 1), key=lambda d: abs(d - wanted))


def observation_size(observation: ObservationConfig) -> int:
    """An upper bound of the number of values that a policy sees."""
    per_block = {"rotation": 9, "targets": 3 * observation.targets, "obstacle_distances": observation.obstacles,
                 "obstacle_vectors": 4 * observation.obstacles, "rays": observation.rays}  # fmt: skip
    return sum(per_block.get(block, 3) for block in observation.blocks)


def memory_estimate(config: Config) -> dict[str, int]:
    """Bytes that training needs, by the setting that asks for them; a coarse upper estimate."""
    algo, size = config.algo, observation_size(config.observation)
    per_sample = 4 * (size + 4 + 6) * 2  # float32: observation, action, 6 scalars; stable-baselines3 copies once
    per_drone = 1024  # state, episode statistics, start
    layers = [a * b for net in (algo.policy_layers, algo.value_layers) for a, b in zip((size, *net), net, strict=False)]
    width = max(*algo.policy_layers, *algo.value_layers)
    x, y, _ = (high - low + 20 for low, high in zip(config.env.bounds_low, config.env.bounds_high, strict=True))
    maps = max(config.level.maps, config.randomization.maps)
    densest = min((spacing.pitch for spacing in config.level.spacings), default=float("inf"))
    per_map = int(x * y) * 256 + int(x * y / densest**2) * 128  # one cell a square metre; one lattice a tree
    curriculum = config.curriculum
    starts = curriculum.room_starts if curriculum.room_rate > 0.0 else 0
    polished = curriculum.polish_starts if curriculum.polish_rounds > 0 else 0
    ahead = curriculum.room_time / config.sim.control_period if curriculum.room_rate > 0.0 else 0.0
    whole = config.env.horizon / config.sim.control_period if polished else 0.0
    derivatives = 8 * (17 * 21 + 13 * size)  # of a step of a flight by itself
    return {
        "algo.n_envs": algo.n_envs * (algo.n_steps * per_sample + per_drone),
        "algo.policy_layers": 16 * sum(layers),  # weights, gradients, Adam's two moments
        "algo.batch_size": algo.batch_size * width * 4 * 8,
        "level.maps": maps * per_map,
        "curriculum.room_starts": starts * (per_drone + 8 * (size + width)),
        "curriculum.polish_starts": polished * (per_drone + 8 * (size + width)),
        "curriculum.room_time": int(ahead * 128 * derivatives),  # 128 flights at once
        "env.horizon": int(whole * 64 * derivatives),  # 64 polished flights at once
    }


def check_memory(config: Config, limit: int) -> None:
    """Refuse a training that would need more bytes than ``limit``; raises `ConfigError` with the estimate."""
    estimate = memory_estimate(config)
    if sum(estimate.values()) > limit:
        path = max(estimate, key=lambda key: estimate[key])
        section, name = path.split(".")
        value = getattr(getattr(config, section), name)
        needed = " GiB, this takes at most ".join(f"{size / 2**30:.3g}" for size in (estimate[path], limit))
        raise ConfigError(f"{path}: got {value}, whose memory is about {needed} GiB; make it smaller")
