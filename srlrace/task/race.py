"""The batched race: state -> observe -> act -> integrate -> collide -> reward, for n drones at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from srlrace.config import Config, CurriculumConfig
from srlrace.sim.airframe import Airframe
from srlrace.task.arrays import LEDGER, TALLY, Fleet, Floats, Memory, Output, Rules, Scratch
from srlrace.task.certificate import certified_field
from srlrace.task.observation import block_codes, observation_size
from srlrace.task.random import make_streams
from srlrace.task.reset import forget_maps, record_size
from srlrace.task.reward import TERMS, weights
from srlrace.task.step import observe_all, reset_all, step_all
from srlrace.world.field import ObstacleField, ray_directions
from srlrace.world.rolling import RollingField
from srlrace.world.track import target_sequence

Field = ObstacleField | RollingField

ACTION_SIZE = 4
STATE_SIZE = 17


@dataclass(frozen=True)
class RaceMode:
    """What distinguishes training from evaluation: resets, curriculum and who draws which random numbers."""

    seed: int
    members: NDArray[np.int64]  # (n,) one random stream each
    autoreset: bool
    curriculum: bool

    @staticmethod
    def training(seed: int, n: int) -> RaceMode:
        """Drones that start anew whenever an episode ends, with the curriculum on."""
        return RaceMode(seed, np.arange(n), autoreset=True, curriculum=True)

    @staticmethod
    def evaluation(seed: int, episodes: NDArray[np.int64]) -> RaceMode:
        """One drone per episode, parked when it ends; initial conditions depend on (seed, episode) alone."""
        return RaceMode(seed, episodes, autoreset=False, curriculum=False)


def make_field(config: Config, mode: RaceMode) -> Field:
    """Draw the maps of a race: certified ones, or in training with ``level.fresh_steps`` ever new ones, uncertified."""
    maps = max(config.level.maps, config.randomization.maps)
    if not (mode.curriculum and config.level.fresh_steps):
        return certified_field(config, range(maps))
    # A map that is no longer offered stays until the longest flight that began on it has ended.
    longest = round(config.env.horizon / config.sim.control_period) + config.algo.n_steps
    spare = math.ceil(longest * len(mode.members) / config.level.fresh_steps) + 1
    return RollingField(config.env, config.level, maps, spare, config.observation.obstacles, config.observation.range)


def make_rules(config: Config, field: Field, mode: RaceMode, dtype: DTypeLike) -> Rules:
    """Collect the constants of a race."""
    track, draw, curriculum = config.env, config.randomization, config.curriculum
    in_training = float(mode.curriculum)  # evaluation knows no curriculum
    airframe = Airframe(config.quad)
    displaced = len(track.waypoints) if draw.every_waypoint else track.displaced_waypoints
    spread = 1.0 + in_training * curriculum.start_margin
    return Rules(
        dt=config.sim.control_period,
        substeps=config.sim.substeps,
        horizon_steps=round(track.horizon / config.sim.control_period),
        sequence=np.array(target_sequence(track), np.int64),
        waypoints=np.array(track.waypoints, dtype),
        start=np.array(track.start, dtype),
        bounds=np.array([*track.bounds_low, *track.bounds_high], dtype),
        passing_radius=track.passing_radius,
        arm_length=config.quad.arm_length,
        keep_out=config.keep_out,
        margin=in_training * curriculum.obstacle_margin,
        margin_steps=round(curriculum.obstacle_margin_after / config.sim.control_period),
        airframe=airframe.pack(dtype),
        hover_thrust=airframe.hover_thrust,
        max_collective=airframe.max_collective,
        body_rate_max=np.array(config.quad.body_rate_max, dtype),
        drag=np.array(airframe.drag_acceleration(), dtype),
        weights=weights(config.reward),
        blocks=block_codes(config.observation),
        targets=config.observation.targets,
        nearest=config.observation.obstacles,
        reach=config.observation.range,
        rays=config.observation.rays,
        directions=ray_directions(config.observation.rays, dtype, config.observation.ray_focus),
        ray_scale=config.observation.ray_scale,
        ray_walls=config.observation.ray_walls,
        facing=config.observation.frame == "target",
        maps=field.maps,
        first_map=0,
        slots=field.slots,
        start_position=spread * draw.position,
        start_velocity=spread * draw.velocity,
        start_attitude=spread * draw.attitude,
        quaternion_draw=draw.attitude_draw == "quaternion",
        min_height=draw.min_height,
        displaced=displaced,
        displacement=draw.waypoint_displacement,
        drag_spread=draw.drag,
        thrust_spread=draw.thrust,
        gate_starts=in_training * curriculum.gate_starts,
        memory_starts=in_training * curriculum.memory_starts,
        retry_starts=in_training * curriculum.retry_starts,
        hard_starts=in_training * curriculum.hard_starts,
        hard_steps=round((curriculum.hard_time or track.horizon) / config.sim.control_period),
        hard_late=curriculum.hard_late,
        escape_starts=in_training * curriculum.escape_starts,
        escapes=np.zeros((0, record_size(len(track.waypoints))), dtype),
        autoreset=mode.autoreset,
        wind=np.zeros((3, 0), dtype),
    )


def make_fleet(rules: Rules, mode: RaceMode, dtype: DTypeLike) -> Fleet:
    """Allocate the state of a race."""
    n, targets = len(mode.members), len(rules.sequence)
    state = np.zeros((STATE_SIZE, n), dtype)
    state[6] = 1.0
    return Fleet(
        state=state,
        plant=np.zeros((4, n), dtype),
        waypoints=np.zeros((*rules.waypoints.shape, n), dtype),
        passing_time=np.zeros((targets, n), dtype),
        tally=np.zeros((len(TALLY), n), dtype),
        target=np.zeros(n, np.int32),
        first_target=np.zeros(n, np.int32),
        steps=np.zeros(n, np.int32),
        last_step=np.full(n, rules.horizon_steps, np.int32),
        map=np.zeros(n, np.int32),
        staged=np.zeros(n, np.bool_),
        parked=np.zeros(n, np.bool_),
        streams=make_streams(mode.seed, mode.members),
        start_streams=np.zeros((2, n), np.uint64),
        rehearsing=np.zeros(n, np.bool_),
        escape=np.full(n, -1, np.int32),
    )


def make_memory(config: Config, rules: Rules, n: int, dtype: DTypeLike) -> Memory:
    """Allocate what resets remember; one entry where they never look."""
    targets, size = len(rules.sequence), record_size(len(config.env.waypoints))
    passings = config.curriculum.memory_size if rules.memory_starts > 0.0 else 1
    failures = config.curriculum.memory_size if rules.retry_starts > 0.0 else 1
    trails, crashes = (n, config.curriculum.memory_size) if rules.hard_starts > 0.0 else (0, 0)
    return Memory(
        record=np.zeros((targets, passings, size), dtype),
        count=np.zeros(targets, np.int64),
        failed=np.zeros((2, failures), np.uint64),
        failures=np.zeros(1, np.int64),
        trail=np.zeros((trails, 2, size + 1), dtype),
        hard=np.zeros((crashes, size + 1), dtype),
        hards=np.zeros(1, np.int64),
    )


def make_output(rules: Rules, n: int, size: int, dtype: DTypeLike) -> Output:
    """Allocate what a step writes."""
    return Output(
        observation=np.zeros((n, size), np.float32),
        terminal_observation=np.zeros((n, size), np.float32),
        reward=np.zeros(n, np.float32),
        reward_terms=np.zeros((len(TERMS), n), np.float32),
        clearance=np.zeros(n, dtype),
        outcome=np.zeros(n, np.int8),
        time=np.zeros(n, np.float64),
        final_tally=np.zeros((len(TALLY), n), dtype),
        final_passing_time=np.zeros((len(rules.sequence), n), dtype),
        final_target=np.zeros(n, np.int32),
        ledger=np.zeros(len(LEDGER) + len(TERMS), np.float64),
    )


def commands(rules: Rules, action: NDArray[Any]) -> NDArray[Any]:
    """Return what actions (..., 4) within [-1, 1] ask for, (..., 4): collective, m/s^2, and body rates, rad/s."""
    collective = 0.5 * (action[..., :1] + 1.0) * rules.max_collective
    return np.concatenate([collective, action[..., 1:] * rules.body_rate_max], axis=-1)


def ramp(done: float, start: float, end: float) -> float:
    """Return 0 until ``start``, 1 from ``end`` on, and a straight line between."""
    return min(max((done - start) / (end - start), 0.0), 1.0) if end > start else float(done >= end)


class Phase(NamedTuple):
    """How far the curriculum is."""

    costs: float  # share of their full weight
    staged: float  # share that is left of gate and memory starts
    hard: float  # share that there is of hard starts
    ease: float  # share that is left of smaller obstacles and larger waypoints


def phase_of(curriculum: CurriculumConfig, done: float) -> Phase:
    """Return the phase when a share of the training is ``done``."""
    grown = ramp(done, curriculum.cost_hold, curriculum.cost_ramp)
    ended = ramp(done, curriculum.staged_hold, curriculum.staged_end)
    return Phase(
        costs=1.0 - (1.0 - curriculum.cost_initial) * (1.0 - grown),
        staged=1.0 - ended,
        hard=ended if done >= curriculum.hard_begin else 0.0,
        ease=1.0 - ramp(done, curriculum.ease_hold, curriculum.ease_end),
    )


class Race:
    """n drones on one track, stepped together by compiled kernels.

    ``output`` holds what the last step produced (see `srlrace.task.arrays.Output`); its arrays are
    overwritten by the next step. ``current_weights`` are the reward's weights as the curriculum has them now.
    """

    def __init__(
        self,
        config: Config,
        mode: RaceMode,
        field: Field | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        self.config = config
        self.field: Field = field or make_field(config, mode)
        self.rules = make_rules(config, self.field, mode, dtype)
        self.n = len(mode.members)
        self.observation_size = observation_size(config.observation)
        self.fleet = make_fleet(self.rules, mode, dtype)
        self.memory = make_memory(config, self.rules, self.n, dtype)
        self.output = make_output(self.rules, self.n, self.observation_size, dtype)
        nearest = config.observation.obstacles
        self._scratch = Scratch(
            np.zeros((4, self.n), dtype),
            np.zeros((3, self.n), dtype),
            np.zeros(nearest, dtype),
            np.zeros(nearest, np.int32),
        )
        self.current_weights = self.rules.weights.copy()
        self._has_curriculum = mode.curriculum
        self.set_progress(0.0)

    def set_progress(self, done: float) -> None:
        """Say which share of training is done: costs grow, staged starts end, sizes become true (`CurriculumConfig`).

        All costs together, not the crash penalty alone: at full weight, flying with wide exploration costs
        more per second (body rates, time, obstacles) than a cheap crash, and the policy learns to crash soon.
        """
        curriculum, full = self.config.curriculum, self.rules.weights
        if not self._has_curriculum:
            self.current_weights[:] = full
            return
        phase = phase_of(curriculum, done)
        self.current_weights[:] = np.where(full < 0.0, full * phase.costs, full)
        self.rules = self.rules._replace(
            gate_starts=curriculum.gate_starts * phase.staged,
            memory_starts=curriculum.memory_starts * phase.staged,
            hard_starts=curriculum.hard_starts * phase.hard,
            keep_out=self.config.keep_out - curriculum.obstacle_ease * phase.ease,
            passing_radius=self.config.env.passing_radius
            - curriculum.waypoint_margin
            + curriculum.waypoint_ease * phase.ease,
        )

    def refresh(self, steps: int) -> None:
        """Offer the maps of a training that has come to so many steps (``level.fresh_steps``), and forget other ones.

        What is offered follows from the steps alone, so that a training resumes exactly. To be called between two
        rollouts, with steps that grow; without fresh maps nothing changes.
        """
        if not isinstance(self.field, RollingField):
            return
        first = self.field.offer(steps // self.config.level.fresh_steps)
        self.rules = self.rules._replace(first_map=first)
        ahead = (np.arange(self.field.slots) - first) % self.field.slots
        forget_maps(self.memory, ahead < self.field.maps)

    def offer_escapes(self, starts: Floats) -> None:
        """Let ``curriculum.escape_starts`` of all resets be from these records, (m, record size)."""
        self.rules = self.rules._replace(escapes=starts.astype(self.rules.waypoints.dtype))

    def reset(self) -> Floats:
        """Start a new episode of every drone; return the observations, (n, d)."""
        reset_all(self.fleet, self.rules, self.field.arrays, self.memory, self._scratch, self.output)
        return self.output.observation

    def step(self, action: NDArray[np.float32]) -> Output:
        """Advance every drone by one control step with ``action`` (n, 4), clipped to [-1, 1]."""
        step_all(
            action,
            self.fleet,
            self.rules,
            self.field.arrays,
            self.memory,
            self._scratch,
            self.output,
            self.current_weights,
        )
        return self.output

    def observe(self, state: Floats) -> Floats:
        """Return what every drone would see in ``state`` (17, n), all else being as it is: (n, d), in ``output``."""
        fleet = self.fleet._replace(state=state)
        observe_all(fleet, self.rules, self.field.arrays, self._scratch, self.output.observation)
        return self.output.observation

    def take_ledger(self) -> dict[str, float]:
        """Return the sums over the episodes that ended since the last call, by name, and empty them."""
        names = [*LEDGER, *(f"reward/{term}" for term in TERMS)]
        taken = dict(zip(names, self.output.ledger.tolist(), strict=True))
        self.output.ledger[:] = 0.0
        return taken

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Return copies of everything that future steps depend on, by name."""
        return {name: array.copy() for name, array in self._named_arrays().items()}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Continue from a `snapshot`; shapes and types must be those of this race."""
        mine = self._named_arrays()
        for name, target in mine.items():
            source = arrays[name]
            if source.shape != target.shape or source.dtype != target.dtype:
                raise ValueError(
                    f"snapshot of {name} is {source.dtype}{source.shape}, not {target.dtype}{target.shape}"
                )
        self._check_indices(arrays)
        for name, target in mine.items():
            target[...] = arrays[name]

    def _check_indices(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Refuse indices out of range: kernels do not check them, and a snapshot may come from a stranger."""
        targets, maps, size = len(self.rules.sequence), self.rules.slots, self.memory.record.shape[1]
        count, record = arrays["memory.count"], arrays["memory.record"]
        written = np.concatenate([record[k, : min(max(count[k], 0), size)] for k in range(targets)])
        hard, trail = arrays["memory.hard"], arrays["memory.trail"]
        noted = np.concatenate([hard[: max(arrays["memory.hards"][0], 0)], trail.reshape(-1, hard.shape[1])])
        checked = {
            "fleet.target": (arrays["fleet.target"], targets),
            "fleet.first_target": (arrays["fleet.first_target"], targets),
            "fleet.map": (arrays["fleet.map"], maps),
            "fleet.steps": (arrays["fleet.steps"], self.rules.horizon_steps),
            "fleet.last_step": (arrays["fleet.last_step"], self.rules.horizon_steps + 1),
            "fleet.escape": (arrays["fleet.escape"] + 1, len(self.rules.escapes) + 1),
            "memory.count": (count, np.iinfo(np.int64).max),
            "memory.failures": (arrays["memory.failures"], np.iinfo(np.int64).max),
            "memory.hards": (arrays["memory.hards"], np.iinfo(np.int64).max),
            "steps of memory.hard and memory.trail": (noted[:, -3], self.rules.horizon_steps + 1),
            "maps of memory.hard and memory.trail": (noted[:, -2], maps),
            "targets of memory.hard and memory.trail": (noted[:, -1], targets),
            "steps of memory.record": (written[:, -2], self.rules.horizon_steps + 1),
            "maps of memory.record": (written[:, -1], maps),
        }
        for name, (values, end) in checked.items():
            if not ((values >= 0) & (values < end)).all():
                raise ValueError(f"snapshot of {name} is not within 0 and {end}")

    def _named_arrays(self) -> dict[str, NDArray[Any]]:
        groups: dict[str, Any] = {"fleet": self.fleet, "memory": self.memory}
        arrays = {f"{g}.{name}": array for g, group in groups.items() for name, array in group._asdict().items()}
        return {**arrays, "output.observation": self.output.observation, "output.ledger": self.output.ledger}
