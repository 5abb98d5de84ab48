"""The last stage: how waypoints are passed, the gradient of time against whole flights, the metric, and the rounds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from srlrace.config import Config, ConfigError
from srlrace.hydra_bridge import compose
from srlrace.learn import polish as polishing
from srlrace.learn import train as training
from srlrace.learn.flight_gradient import RoomGradient, TimeGradient
from srlrace.learn.flights import FREE, HOPELESS, MISSED, OVER, Flights, at_first_target, drawn_starts, least_room
from srlrace.learn.lean_ppo import LeanPPO
from srlrace.learn.policy import mean_action
from srlrace.learn.polish import DAMPING, NEARLY, ActionMetric, Look, Polish, conjugate_gradients
from srlrace.learn.ppo import build_ppo, capture, reinstate
from srlrace.learn.tensors import TensorFileError
from srlrace.learn.train import train
from srlrace.task.race import Race, RaceMode
from srlrace.task.vec_env import RaceVecEnv

ROLLOUT = 16 * 32
SMALL = [
    "env=forest", "algo.n_envs=16", "algo.n_steps=32", "algo.batch_size=256", "algo.n_epochs=1",
    "algo.policy_layers=[16,16]", "algo.value_layers=[16]", f"algo.total_steps={4 * ROLLOUT}", "env.horizon=2",
    "curriculum.polish_rounds=3", "curriculum.polish_starts=300", "curriculum.polish_beginnings=0",
]  # fmt: skip


def settings(*overrides: str) -> Config:
    """The small training, but for the overrides."""
    words = dict(word.split("=", 1) for word in (*SMALL, *overrides))
    return compose([f"{name}={value}" for name, value in words.items()])


def learner(*overrides: str) -> tuple[LeanPPO, RaceVecEnv]:
    env = RaceVecEnv(settings(*overrides))
    model = build_ppo(env.race.config, env)
    assert isinstance(model, LeanPPO)
    return model, env


def polish_of(model: LeanPPO) -> Polish:
    assert model.polish is not None
    return model.polish


def before_last_waypoint(race: Race, n: int, across: float = 0.15, before: float = 1.5) -> NDArray[Any]:
    """Drones ``before``, m, the last waypoint that fly at it, more or less."""
    rng = np.random.default_rng(0)
    starts = at_first_target(drawn_starts(race, n)).astype(np.float64)
    starts[:, :3] = race.rules.waypoints[-1] - [before, 0.0, 0.0] + rng.uniform(-across, across, (n, 3))
    starts[:, 3:6] = np.array([5.0, 0.0, 0.0]) + rng.uniform(-0.3, 0.3, (n, 3))
    starts[:, 6:10], starts[:, 10:13] = [1.0, 0.0, 0.0, 0.0], 0.0
    starts[:, -1] = len(race.rules.sequence) - 1
    return starts


def test_how_far_inside_its_sphere_a_waypoint_is_passed() -> None:
    model, env = learner("level=none")
    starts, n = before_last_waypoint(env.race, 200, 0.4), 200
    flights, radius, goal = Flights(env.race, n, 0.1), env.race.rules.passing_radius, env.race.rules.waypoints[-1]
    flights.begin(starts)
    found, nearest = np.full(n, OVER), np.full(n, OVER)
    for _ in range(30):
        before = flights.fleet.state[:3].copy()
        flights.fly(model.mean_action(flights.see()))
        found = np.minimum(found, flights.passing()[0])
        share = np.linspace(0.0, 1.0, 201)[:, None, None]
        chord = before.T + share * (flights.fleet.state[:3].T - before.T)
        nearest = np.minimum(nearest, np.linalg.norm(chord - goal, axis=2).min(0))
    near = nearest < radius + MISSED
    assert 20 < (nearest > radius).sum() < 180
    np.testing.assert_array_equal(flights.finished, nearest <= radius)
    np.testing.assert_allclose(found[near], radius - nearest[near] + 0.1, atol=1e-4)
    assert (found[~near] == OVER).all()
    without = Flights(env.race, n)
    assert (least_room(without, model.mean_action, starts, 12) > 0.3).all(), "where they do not count"


def test_the_gradient_of_room_is_that_of_passing_where_that_is_less() -> None:
    model, env = learner("level=none")
    starts, wanted, steps = before_last_waypoint(env.race, 64), 0.4, 25
    gradient, flights = RoomGradient(env.race, model.policy, 64, steps, 0.0), Flights(env.race, 64, 0.0)
    room = gradient(starts, wanted, -1.0)
    assert (room < env.race.rules.passing_radius).all()
    check_gradient(model, lambda: lack(least_room(flights, model.mean_action, starts, steps), wanted), 1e-3, 0.05)


def lack(room: NDArray[np.float64], wanted: float) -> float:
    return float(np.maximum(wanted - room, 0.0).mean())


def check_gradient(model: LeanPPO, quantity: Any, distance: float, tolerance: float) -> None:
    """Compare the gradient that the parameters have, along it, with differences of the quantity."""
    parameters = [p for p in model.policy.parameters() if p.grad is not None]
    gradient = [p.grad.clone() for p in parameters if p.grad is not None]
    norm = float(torch.cat([g.flatten() for g in gradient]).norm())
    assert norm > 0.0
    values = []
    for way in (distance, -2.0 * distance):
        with torch.no_grad():
            for p, g in zip(parameters, gradient, strict=True):
                p += way / norm * g
        values.append(quantity())
    assert (values[0] - values[1]) / (2.0 * distance) == pytest.approx(norm, rel=tolerance)


def test_the_gradient_of_time_is_that_of_whole_flights() -> None:
    model, env = learner("level=none")
    n, rules = 64, env.race.rules
    starts = before_last_waypoint(env.race, n, 0.05, 3.0)
    counted = TimeGradient(env.race, model.policy, n, 40)(starts)
    assert counted.all()

    def mean_time() -> float:
        """When flights enter the sphere."""
        flights, goal = Flights(env.race, n), rules.waypoints[-1]
        flights.begin(starts)
        time = np.full(n, np.nan)
        for step in range(40):
            flights.fly(model.mean_action(flights.see()))
            new = flights.finished & np.isnan(time)
            velocity, end = flights.velocity, flights.fleet.state[:3].T - goal
            square, along = (velocity**2).sum(1), (velocity * end).sum(1)
            inside = along**2 - square * ((end**2).sum(1) - rules.passing_radius**2)
            since = (along + np.sqrt(np.maximum(inside, 0.0))) / square
            time[new] = ((step + 1) * rules.dt - since)[new]
        return float(time.mean())

    # The gradient is that of where a drone is after the step, a little later.
    check_gradient(model, mean_time, 3e-3, 0.1)


def test_flights_that_crash_or_are_late_do_not_count_for_the_time() -> None:
    model, env = learner("level=none")
    starts = before_last_waypoint(env.race, 4, 0.0)
    starts[0, 0] -= 1.0
    starts[1, 2] = 0.01
    starts[1, 5] = -3.0
    counted = TimeGradient(env.race, model.policy, 4, 16)(starts)
    assert counted.tolist() == [False, False, True, True]


def test_conjugate_gradients_solve() -> None:
    rng = torch.Generator().manual_seed(0)
    root = torch.randn(8, 8, generator=rng, dtype=torch.float64)
    matrix, right = root @ root.T + torch.eye(8), torch.randn(8, generator=rng, dtype=torch.float64)
    solved = conjugate_gradients(lambda v: matrix @ v, right, 20)
    np.testing.assert_allclose(solved, torch.linalg.solve(matrix, right), rtol=1e-6)
    assert not conjugate_gradients(lambda v: matrix @ v, torch.zeros(8), 20).any()


@pytest.mark.parametrize("overrides", [(), ("algo.state_dependent_std=true",)])
def test_a_way_is_that_of_the_natural_gradient_and_as_long_as_asked(
    overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, _ = learner("algo.policy_layers=[4]", *overrides)
    policy, rng = model.policy, torch.Generator().manual_seed(0)
    metric, observations = ActionMetric(policy), torch.randn(50, *policy.observation_space.shape, generator=rng)
    before = {name: weight.clone() for name, weight in metric.weights.items()}
    for p in (*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()):
        p.grad = torch.randn(p.shape, generator=rng)
    actor = [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()]
    gradient = torch.cat([p.grad.flatten() for p in actor if p.grad is not None])
    rows = []
    for row in mean_action(policy, observations).flatten():
        parts = torch.autograd.grad(row, actor, retain_graph=True)
        rows.append(torch.cat([part.flatten() for part in parts]))
    jacobian = torch.stack(rows).double()
    fisher = jacobian.T @ jacobian / len(observations) + DAMPING * torch.eye(jacobian.shape[1])
    monkeypatch.setattr(polishing, "ITERATIONS", 500)
    way = torch.cat([part.flatten() for part in metric.way(observations, 1e-3).values()]).double()
    expected = -torch.linalg.solve(fisher, gradient.double())
    assert float(way @ expected / way.norm() / expected.norm()) > 0.999
    assert float((way @ fisher @ way).sqrt()) == pytest.approx(1e-3, rel=1e-2)
    assert all(not p.grad.any() for p in actor if p.grad is not None), "cleared"
    assert all(torch.equal(weight, before[name]) for name, weight in metric.weights.items()), "not gone yet"
    assert not any(part.any() for part in metric.way(observations, 1e-3).values()), "no gradient, no way"


def test_rounds_make_room() -> None:
    model, env = learner("curriculum.polish_wanted=0.3", "curriculum.polish_room=0.05", "curriculum.polish_time=0")
    polish, starts = polish_of(model), at_first_target(drawn_starts(env.race, 500, 10**6))
    flights = Flights(env.race, len(starts))
    before = least_room(flights, model.mean_action, starts, 60)
    while not polish.finished:
        polish.round()
    after = least_room(flights, model.mean_action, starts, 60)
    assert lack(after, 0.3) < 0.8 * lack(before, 0.3)


def test_steps_get_shorter_and_a_bad_round_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = learner("curriculum.polish_rounds=5", "curriculum.polish_time=0.01")
    polish, shares = polish_of(model), iter([0.01, 0.012, 0.5, 0.01, 0.002, 0.001, 0.9, 0.001])
    nothing = np.zeros((0, 1))
    bias = model.policy.action_net.bias
    at_first, looks, changes = float(bias[1].detach()), [], []

    def look(_: Any) -> Look:
        looks.append(round(float(bias[1].detach()) - at_first))
        return Look(nothing, nothing, nothing[:, 0], np.zeros((1, 3), np.float32), 0.0, next(shares))

    def take_steps(*_: Any) -> None:
        changes.append(polish._caution)
        model.parameters[:] += 1.0

    monkeypatch.setattr(polish, "_look", look)
    monkeypatch.setattr(polish, "_take_steps", take_steps)
    for _ in range(6):
        assert not polish.finished
        polish.round()
    assert polish.finished
    assert changes == [1.0, 1.0, 0.5, 0.5, 0.5]
    assert looks == [0, 1, 2, 0, 1, 2, 3, 2]


def test_a_round_looks_at_flights_that_no_other_has(monkeypatch: pytest.MonkeyPatch) -> None:
    model, env = learner("curriculum=taught_course", "curriculum.polish_rounds=2")
    polish, looks = polish_of(model), []
    monkeypatch.setattr(polish, "_take_steps", lambda look, rng: looks.append((look, rng.random())))
    for _ in range(2):
        polish.round()
    (first, one), (second, other) = looks
    assert one != other
    assert first.starts.shape == second.starts.shape == (300, first.places.shape[1])
    assert not (first.starts[:, None, :2] == second.starts[None, :, :2]).all(2).any()
    assert len(first.places) == len(first.lack) > 0
    assert 0.5 < first.failed <= 1.0, "an untrained policy hits something"
    assert len(first.seen) > 100
    assert first.steps > 5.0
    room = least_room(Flights(env.race, len(first.places), 0.02), model.mean_action, first.places, 60)
    np.testing.assert_allclose(np.maximum(0.04 - room, 0.0), first.lack, atol=1e-9)


def test_a_round_finds_hard_starts_among_more_beginnings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polishing, "AT_ONCE", 1000)
    plain, env = learner("curriculum.polish_wanted=0.1")
    model, _ = learner("curriculum.polish_wanted=0.1", "curriculum.polish_beginnings=2500")
    without, look = (polish_of(one)._look(np.random.default_rng(0)) for one in (plain, model))
    whole = len(without.places)
    np.testing.assert_array_equal(look.places[:whole], without.places)
    hard, lack = look.places[whole:], look.lack[whole:]
    drawn = at_first_target(drawn_starts(env.race, 2500, 4 * 300, widened=False))
    flights = Flights(env.race, 2500, 0.08)
    flights.begin(drawn)
    dangerous = flights.clearance() < FREE
    room = least_room(flights, plain.mean_action, drawn, 30)
    dangerous &= (room < 0.1 + NEARLY) & (room > -HOPELESS)
    assert 0 < dangerous.sum() < 2500
    np.testing.assert_array_equal(hard, drawn[dangerous])
    np.testing.assert_allclose(lack, np.maximum(0.1 - room[dangerous], 0.0), atol=1e-9)


def test_who_is_not_hopeless_is_helped(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, counted = [], []
    call = RoomGradient.__call__

    def watched(self: RoomGradient, records: NDArray[Any], wanted: float, hopeless: float) -> NDArray[np.float64]:
        counted.append(-hopeless)
        return call(self, records, wanted, hopeless)

    monkeypatch.setattr(RoomGradient, "__call__", watched)
    for depth in ("0.01", "5"):
        model, _ = learner(f"curriculum.polish_hopeless={depth}", "curriculum.polish_time=0")
        polish = polish_of(model)
        looks.append(polish._look(np.random.default_rng(0)))
        polish._take_steps(looks[-1], np.random.default_rng(0))
    few, many = (look.lack for look in looks)
    assert few.max() < 0.04 + 0.01 < 1.0 < many.max()
    assert 0 < len(few) < len(many)
    assert sorted(set(counted)) == pytest.approx([0.8 * 0.01, 0.8 * 5.0])


def test_no_start_is_looked_at_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = learner("curriculum.polish_beginnings=500", "curriculum.polish_rounds=2")
    polish, flown = polish_of(model), []
    monkeypatch.setattr(polish, "_take_steps", lambda look, rng: None)

    def watched(real: Any) -> Any:
        def fly(flights: Flights, act: Any, starts: Any, *rest: Any) -> Any:
            flown.append(starts)
            return real(flights, act, starts, *rest)

        return fly

    for name in ("close_places", "close_starts"):
        monkeypatch.setattr(polishing, name, watched(getattr(polishing, name)))
    while not polish.finished:
        polish.round()
    starts = np.vstack(flown)
    assert len(starts) == 3 * (300 + 500)
    assert len(np.unique(starts[:, :2], axis=0)) == len(starts)


def test_what_is_interrupted_ends_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings()
    whole = train(config, tmp_path / "whole")
    plain = train(settings("curriculum.polish_rounds=0"), tmp_path / "plain")
    weights = [(folder / "policy.safetensors").read_bytes() for folder in (whole, plain)]
    assert weights[0] != weights[1]
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    take_round, taken = Polish.round, []
    for stop in (0, 1, 3):

        def fail(self: Polish, stop: int = stop) -> None:
            if self._looks == stop:
                raise RuntimeError("lightning")
            taken.append(self._looks)
            take_round(self)

        with monkeypatch.context() as patch:
            patch.setattr(Polish, "round", fail)
            with pytest.raises(RuntimeError, match="lightning"):
                train(config, tmp_path / "parts")
    assert taken == [0, 1, 2], "none twice"
    parts = train(config, tmp_path / "parts")
    assert (parts / "policy.safetensors").read_bytes() == weights[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("looks", 5.0),
        ("looks", -1.0),
        ("looks", 0.5),
        ("looks", np.zeros(2)),
        ("caution", 2.0),
        ("failed", np.nan),
        ("best.1.bias", np.zeros(9, np.float32)),
        ("best.1.bias", np.zeros(4)),
        ("best.1.bias", np.full(4, np.nan, np.float32)),
    ],
)
def test_a_strangers_checkpoint_is_refused(name: str, value: Any) -> None:
    model, env = learner()
    model._setup_learn(ROLLOUT, None)
    arrays = capture(model, env)
    reinstate(model, env, arrays | {"polish/looks": np.array(4.0)})
    assert polish_of(model).finished
    with pytest.raises(TensorFileError, match="not the state of this training"):
        reinstate(model, env, arrays | {f"polish/{name}": np.array(value)})


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("level=mixed", "level.fresh_steps=1000"), r"polish_rounds: takes 0 with level\.fresh_steps"),
        (("algo.averaged=0.2",), r"polish_rounds: takes 0 with algo\.averaged"),
        (("curriculum.polish_wanted=-1",), r"polish_wanted"),
        (("curriculum.polish_inside=0.3",), r"polish_inside: got 0\.3; takes less than env\.passing_radius, 0\.3"),
    ],
)
def test_what_cannot_be_polished_is_refused(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings(*overrides)


def test_a_single_flight_is_too_few_to_learn_from() -> None:
    model, _ = learner("curriculum.polish_starts=1", "curriculum.polish_wanted=0", "curriculum.polish_inside=0")
    polish = polish_of(model)
    while not polish.finished:
        polish.round()
    assert np.isfinite(model.parameters).all()


def test_drawn_starts_go_on_where_others_ended() -> None:
    race = Race(settings(), RaceMode.training(0, 16))
    np.testing.assert_array_equal(drawn_starts(race, 6)[4:], drawn_starts(race, 2, 4))


def test_a_look_flies_from_the_ranges_of_the_evaluation() -> None:
    race = Race(settings("curriculum.start_margin=0.5"), RaceMode.training(0, 16))
    for widened, far in ((True, 1.4), (False, 1.0)):
        spread = np.abs(drawn_starts(race, 2000, widened=widened)[:, :2] - race.rules.start[:2]).max()
        assert far - 0.1 < spread < far + 0.1
