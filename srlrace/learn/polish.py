"""The last stage of a training: natural-gradient steps along whole flights, towards less time and more room.

PPO ends where its noise ends: it cannot tell flights apart that differ by a hundredth of a second, nor mend what one
flight in ten thousand hits. The gradients of time and room through the simulator (`srlrace.learn.flight_gradient`)
can. A step of the natural gradient is the longest way along a gradient that changes the policy's actions on ordinary
flights by no more than so much (Kakade, "A Natural Policy Gradient", NIPS 2001; Schulman et al., "Trust Region Policy
Optimization", ICML 2015, find it by conjugate gradients, too): so what mends one flight hardly touches the others.
docs/training.md says what it brings.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn
from torch.func import functional_call, jvp, vjp

from srlrace.bound.escapes import Escapes
from srlrace.learn.flight_gradient import RoomGradient, TimeGradient
from srlrace.learn.flights import (
    NOT_LOST,
    Act,
    Flights,
    Floats,
    at_first_target,
    close_places,
    close_starts,
    drawn_starts,
)
from srlrace.task.race import Race

# All ours.
STEPS = 20  # of a round
CLOSE_FLIGHTS, TIMED_FLIGHTS = 128, 64  # whose gradients make a step
AHEAD = 1.2  # s of a flight up to where it comes closest
BEGINNING = 0.6  # s of a flight
AT_ONCE = 20_000  # beginnings
NEARLY = 0.01  # m: places with up to so much more room than is wanted are flown, too, though less often
DEEP = 0.02  # m: who gets deeper into something is not flown more often for it
SLOWER = 1.1  # times the mean time of a flight: those that take longer do not count for the time
TIMED = 0.65  # share of the rounds after which there are no steps towards less time, reached linearly
LAST = 0.15  # of the size of steps towards more room would be left after the last round, linearly from then on
SAMPLED = 1 / 250  # of the observations of all flights are kept: about one of each flight
OBSERVATIONS = 4096  # of these make the metric of a step
DAMPING = 1e-3  # added to the metric
ITERATIONS = 12  # of conjugate gradients, at most
SOLVED = 1e-12  # of the squared residual at first is none: float32 has no more to give
WORSE, TOLERATED = 2.0, 0.005  # times the share of flights that fail, and so much more of all: that was a bad round

logger = logging.getLogger(__name__)


class Look(NamedTuple):
    """What whole flights show."""

    starts: NDArray[Any]  # (n, record size + 1): where they began, known hard starts excepted
    places: NDArray[Any]  # (k, record size + 1): not long before some of them come close to something, or hard starts
    lack: Floats  # (k,) m, of what is wanted there
    seen: NDArray[np.float32]  # (m, d): observations from anywhere
    steps: float  # that a flight takes
    failed: float  # share of all flights that touch something, or miss a waypoint


class Polish:
    """Rounds of natural-gradient steps, each round from a look at ``curriculum.polish_starts`` new whole flights on.

    Steps that are too long ruin a policy. If a look finds that far more flights fail than after the best round so far,
    its weights come back, and steps towards less time are half as long from then on.
    """

    def __init__(self, race: Race, policy: ActorCriticPolicy, act: Act, escapes: Escapes | None) -> None:
        """``act`` are the mean actions of the ``policy``, fast; ``escapes`` hold further starts."""
        self._race, self._policy, self._act = race, policy, act
        self._known = at_first_target(escapes.start) if escapes else None
        self._metric = ActionMetric(policy)
        self._ahead = max(round(AHEAD / race.config.sim.control_period), 1)
        curriculum = race.config.curriculum
        self._ease = curriculum.polish_wanted - curriculum.polish_inside
        self._rounds = curriculum.polish_rounds
        self._looks = 0
        self._caution = 1.0  # how long steps towards less time are, as a share of what they were to be
        self._best = self._metric.weights  # those after the round so far that left the fewest failures
        self._failed = 1.0  # share of flights that failed then

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to do."""
        return self._looks > self._rounds

    def capture(self) -> dict[str, NDArray[Any]]:
        """Return what the next round depends on, besides the policy's weights."""
        counters = {"looks": self._looks, "caution": self._caution, "failed": self._failed}
        best = {f"best.{name}": weight.numpy() for name, weight in self._best.items()}
        return {name: np.array(value) for name, value in counters.items()} | best

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Go on from what `capture` returned; `ValueError` or `KeyError` where it is not of such a stage."""
        looks, caution, failed = (float(arrays[name].item()) for name in ("looks", "caution", "failed"))
        if not (looks in range(self._rounds + 2) and 0.0 <= caution <= 1.0 and 0.0 <= failed <= 1.0):
            raise ValueError(f"polish has no such state: {looks} looks, {caution}, {failed}")
        best = {name: torch.from_numpy(np.array(arrays[f"best.{name}"])) for name in self._best}
        for name, weight in best.items():
            like = self._best[name]
            if (weight.shape, weight.dtype) != (like.shape, like.dtype) or not bool(torch.isfinite(weight).all()):
                raise ValueError(f"the best weights of the polish: {name} has another shape or type, or is not finite")
        self._looks, self._caution, self._failed, self._best = int(looks), caution, failed, best

    def round(self) -> None:
        """Look where flights come close, and take steps; after the last ones, just look."""
        rng = np.random.default_rng([self._race.config.seed, self._looks])
        look = self._look(rng)
        if look.failed <= self._failed:
            self._best, self._failed = self._metric.weights, look.failed
        elif look.failed > WORSE * self._failed + TOLERATED:
            logger.info("polish: that was worse; back to the best round, with steps half as long")
            self._metric.weights, self._caution = self._best, 0.5 * self._caution
            look = self._look(rng)
        if self._looks < self._rounds and len(look.seen):
            self._take_steps(look, rng)
        self._looks += 1

    def _take_steps(self, look: Look, rng: np.random.Generator) -> None:
        curriculum = self._race.config.curriculum
        share = self._looks / self._rounds
        time_change = self._caution * curriculum.polish_time * max(1.0 - share / TIMED, 0.0)
        room_change = curriculum.polish_room * (1.0 - (1.0 - LAST) * max(share - TIMED, 0.0) / (1.0 - TIMED))
        room_of = RoomGradient(self._race, self._policy, CLOSE_FLIGHTS, self._ahead, self._ease)
        time_of = TimeGradient(self._race, self._policy, TIMED_FLIGHTS, round(SLOWER * look.steps))
        # m: the more often the more is lacking, but others as well
        often = np.minimum(look.lack, curriculum.polish_wanted + DEEP) + 1e-4
        for _ in range(STEPS):
            observations = torch.from_numpy(look.seen[rng.permutation(len(look.seen))[:OBSERVATIONS]])
            ways = []
            if time_change > 0.0:
                time_of(look.starts[rng.choice(len(look.starts), TIMED_FLIGHTS)])
                ways.append(self._metric.way(observations, time_change))
            if room_change > 0.0 and len(look.places):
                close = rng.choice(len(look.places), CLOSE_FLIGHTS, p=often / often.sum())
                room_of(look.places[close], curriculum.polish_wanted, -NOT_LOST * curriculum.polish_hopeless)
                ways.append(self._metric.way(observations, room_change))
            for way in ways:
                self._metric.move(way)

    def _look(self, rng: np.random.Generator) -> Look:
        """Fly whole flights from starts that no other round has, and from known hard ones."""
        curriculum = self._race.config.curriculum
        n, wanted, hopeless = curriculum.polish_starts, curriculum.polish_wanted, curriculum.polish_hopeless
        starts = drawn = at_first_target(drawn_starts(self._race, n, self._looks * n, widened=False))
        if self._known is not None:
            starts = np.vstack([self._known, drawn])
        seen: list[NDArray[np.float32]] = []
        steps = 0

        def watch(observation: NDArray[np.float32], flying: NDArray[np.bool_]) -> None:
            nonlocal steps
            seen.append(observation[flying & (rng.random(len(flying)) < SAMPLED)])
            steps += int(flying.sum())

        flights = Flights(self._race, len(starts), self._ease)
        room, places, left = close_places(flights, self._act, starts, self._ahead, wanted + NEARLY, hopeless, watch)
        hard = list(self._hard_starts(flights, wanted + NEARLY, hopeless))
        places = np.vstack([places, *(there for there, _ in hard)])
        left = np.concatenate([left, *(room for _, room in hard)])
        steps_each = steps / len(starts)
        logger.info(
            "polish %d/%d: %d flights of %.2f s on average, %d of them closer than wanted, %d fail; %d hard starts",
            self._looks, self._rounds, len(starts), steps_each * self._race.rules.dt,
            int((room < wanted).sum()), int((room < 0.0).sum()), sum(len(there) for there, _ in hard),
        )  # fmt: skip
        return Look(
            starts=drawn,
            places=places,
            lack=np.maximum(wanted - left, 0.0),
            seen=np.concatenate(seen),
            steps=steps_each,
            failed=float((room < 0.0).mean()),
        )

    def _hard_starts(self, flights: Flights, enough: float, hopeless: float) -> Iterator[tuple[NDArray[Any], Floats]]:
        """Fly the beginnings of flights from yet other starts; yields those that come close at once, and their room."""
        curriculum = self._race.config.curriculum
        first = (self._rounds + 1) * curriculum.polish_starts + self._looks * curriculum.polish_beginnings
        end = first + curriculum.polish_beginnings
        steps = round(BEGINNING / self._race.config.sim.control_period)
        for begin in range(first, end, AT_ONCE):
            drawn = drawn_starts(self._race, min(AT_ONCE, end - begin), begin, widened=False)
            yield close_starts(flights, self._act, at_first_target(drawn), steps, enough, hopeless)


class ActionMetric:
    """Steps of a policy network, measured by how much they change its mean actions."""

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self._network = nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
        self._parameters = dict(self._network.named_parameters())
        self._actions = policy.log_std.numel()

    @property
    def weights(self) -> dict[str, Tensor]:
        """A copy of the network's weights, by name; set, they are written to where they are."""
        return {name: p.detach().clone() for name, p in self._parameters.items()}

    @weights.setter
    @torch.no_grad()
    def weights(self, weights: dict[str, Tensor]) -> None:
        for name, p in self._parameters.items():
            p.copy_(weights[name])

    def way(self, observations: Tensor, change: float) -> dict[str, Tensor]:
        """Return how to go against the gradient in the weights' ``grad``, which is cleared.

        So far that mean actions on ``observations`` (m, d) change by ``change``, root mean square of their norm;
        nowhere where there is no gradient.
        """
        gradient = _flat(torch.zeros_like(p) if p.grad is None else p.grad for p in self._parameters.values())
        self._network.zero_grad()
        weights = self.weights

        def act(weights: dict[str, Tensor]) -> Tensor:
            output: Tensor = functional_call(self._network, weights, observations)
            return output[:, : self._actions]

        back = cast(Callable[[Tensor], tuple[dict[str, Tensor]]], vjp(act, weights)[1])

        def metric(way: Tensor) -> Tensor:
            changes: Tensor = jvp(act, (weights,), (self._shaped(way),))[1]
            return _flat(back(changes / len(observations))[0].values()) + DAMPING * way

        way = conjugate_gradients(metric, gradient, ITERATIONS)
        size = float((way @ metric(way)).clamp(min=0.0).sqrt())
        return self._shaped(way * (-change / size if size > 0.0 else 0.0))

    def _shaped(self, flat: Tensor) -> dict[str, Tensor]:
        """Cut a vector into tensors like the weights."""
        parts = flat.split([p.numel() for p in self._parameters.values()])
        return {name: part.view_as(p) for part, (name, p) in zip(parts, self._parameters.items(), strict=True)}

    @torch.no_grad()
    def move(self, way: dict[str, Tensor]) -> None:
        """Change the weights, where they are."""
        for name, p in self._parameters.items():
            p.add_(way[name])


def _flat(tensors: Iterable[Tensor]) -> Tensor:
    return torch.cat([tensor.flatten() for tensor in tensors])


def conjugate_gradients(product: Callable[[Tensor], Tensor], right: Tensor, iterations: int) -> Tensor:
    """Solve product(x) = right, for a symmetric positive definite product, as far as so many ``iterations`` come."""
    x, residual = torch.zeros_like(right), right.clone()
    direction, square = residual.clone(), residual @ residual
    solved = SOLVED * float(square)
    for _ in range(iterations):
        if not float(square) > solved:
            break
        image = product(direction)
        length = square / (direction @ image)
        x, residual = x + length * direction, residual - length * image
        direction, square = residual + (residual @ residual) / square * direction, residual @ residual
    return x
