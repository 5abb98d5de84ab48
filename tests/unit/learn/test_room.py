"""The gradient of the room that flights leave, against whole flights, and the steps along it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.bound.escapes import load_escapes
from srlrace.config import ConfigError
from srlrace.hydra_bridge import compose
from srlrace.learn import train as training
from srlrace.learn.flight_gradient import RoomGradient
from srlrace.learn.flights import HOPELESS, OVER, Flights, at_first_target, before_closest, drawn_starts, least_room
from srlrace.learn.lean_ppo import LeanPPO
from srlrace.learn.ppo import build_ppo, capture, reinstate
from srlrace.learn.room_ascent import NEARLY, RoomAscent
from srlrace.learn.tensors import TensorFileError
from srlrace.learn.train import train
from srlrace.task.race import Race, RaceMode
from srlrace.task.reset import nominal_records, put_records, record_size, records
from srlrace.task.vec_env import RaceVecEnv

ROLLOUT = 16 * 32
SMALL = [
    "env=forest", "algo.n_envs=16", "algo.n_steps=32", "algo.batch_size=256", "algo.n_epochs=1",
    "algo.policy_layers=[32,32]", "algo.value_layers=[16]", f"algo.total_steps={20 * ROLLOUT}",
    "curriculum.room_time=0.5", "curriculum.room_starts=2000",
]  # fmt: skip


def learner(*overrides: str) -> tuple[LeanPPO, RaceVecEnv]:
    env = RaceVecEnv(compose([*SMALL, "curriculum.room_rate=1e-3", *overrides]))
    model = build_ppo(env.race.config, env)
    assert isinstance(model, LeanPPO)
    return model, env


def ascent_of(model: LeanPPO) -> RoomAscent:
    assert model.room_ascent is not None
    return model.room_ascent


def known_starts(race: Race) -> NDArray[Any]:
    escapes = load_escapes(race.config)
    assert escapes is not None
    return at_first_target(escapes.start)


def actor(policy: ActorCriticPolicy) -> list[torch.nn.Parameter]:
    return [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()]


def lack(room: NDArray[np.float64], wanted: float, hopeless: float) -> float:
    """What the gradient is of."""
    return float((np.maximum(wanted - room, 0.0) * (room > hopeless)).mean())


def test_drones_fly_as_in_the_race() -> None:
    race = Race(compose([*SMALL, "randomization=full"]), RaceMode.evaluation(3, np.arange(50)), dtype=np.float64)
    race.reset()
    flights = Flights(race, 50)
    flights.begin(at_first_target(records(race.fleet)))
    rng = np.random.default_rng(0)
    for _ in range(25):
        flying = ~race.fleet.parked
        np.testing.assert_allclose(flights.see()[flying], race.observe(race.fleet.state)[flying], atol=1e-6)
        action = rng.uniform(-1.5, 1.5, (50, 4)).astype(np.float32)
        race.step(action)
        flights.fly(action)
        flying = ~race.fleet.parked
        np.testing.assert_allclose(flights.fleet.state[:, flying], race.fleet.state[:, flying], atol=1e-6)
        np.testing.assert_array_equal(flights.fleet.target[flying], race.fleet.target[flying])
        assert (flights.room()[flying] > 0.0).all()
    assert 5 < flying.sum() < 50


def test_room_is_what_is_left_before_a_crash() -> None:
    race = Race(compose(SMALL), RaceMode.evaluation(0, np.arange(4)))
    race.reset()
    flights, rules = Flights(race, 4), race.rules
    flights.begin(at_first_target(records(race.fleet)))
    state = flights.fleet.state
    state[2] = [1.0, 0.25, 0.02, -0.3]
    gaps = race.field.gaps(np.ascontiguousarray(state[:3].T)) - rules.keep_out  # type: ignore[union-attr]
    np.testing.assert_allclose(flights.room(), np.minimum(gaps, state[2] - rules.bounds[2]), atol=1e-5)
    flights.fleet.target[3] = len(rules.sequence)
    assert flights.room()[3] == OVER


@pytest.mark.parametrize("overrides", [(), ("algo.state_dependent_std=true", "algo.activation=elu")])
def test_the_gradient_is_that_of_whole_flights(overrides: tuple[str, ...]) -> None:
    model, env = learner(*overrides)
    policy, start = model.policy, known_starts(env.race)[:96]
    steps, wanted, hopeless = 20, 0.3, -10.0  # where a flight that is hopeless begins to count, there is a jump
    gradient = RoomGradient(env.race, policy, 96, steps)
    room = gradient(start, wanted, hopeless)
    flights = Flights(env.race, 96)
    np.testing.assert_allclose(room, least_room(flights, model.mean_action, start, steps), atol=1e-6)
    assert ((room < wanted) & (room > hopeless)).sum() > 40
    found = [p.grad.clone() for p in actor(policy) if p.grad is not None]
    norm = float(torch.cat([g.flatten() for g in found]).norm())
    rng = torch.Generator().manual_seed(0)
    along = [g / norm for g in found]
    across = [torch.randn(p.shape, generator=rng) / sum(p.numel() for p in found) ** 0.5 for p in found]
    for way in (along, across):
        moved = []
        for distance in (1e-3, -2e-3, 1e-3):  # and back
            with torch.no_grad():
                for p, w in zip(actor(policy), way, strict=True):
                    p += distance * w
            moved.append(lack(least_room(flights, model.mean_action, start, steps), wanted, hopeless))
        expected = sum(float((g * w).sum()) for g, w in zip(found, way, strict=True))
        assert (moved[0] - moved[1]) / 2e-3 == pytest.approx(expected, abs=0.02 * norm)


def test_actions_beyond_their_limit_come_back() -> None:
    model, env = learner()
    with torch.no_grad():
        model.policy.action_net.bias[:] = torch.tensor([-2.0, 2.0, -2.0, 2.0])  # type: ignore[operator,index]
    RoomGradient(env.race, model.policy, 96, 20)(known_starts(env.race)[:96], 0.3, -0.5)
    bias = model.policy.action_net.bias.grad
    assert bias is not None
    assert (bias != 0.0).all()


def test_places_lead_to_where_a_flight_comes_closest() -> None:
    model, env = learner("level=2")
    starts, lead = at_first_target(drawn_starts(env.race, 2000)), 15
    room, places = before_closest(Flights(env.race, len(starts)), model.mean_action, starts, lead)
    assert (room < 0.0).mean() > 0.98, "an untrained policy hits something"
    moved = (places != starts).any(1)
    assert 0.5 < moved.mean() < 1.0
    again = Flights(env.race, len(starts))
    np.testing.assert_allclose(least_room(again, model.mean_action, places, lead)[moved], room[moved], atol=1e-9)
    assert (least_room(again, model.mean_action, places, lead - 1) > room)[moved].all()


def test_who_has_finished_comes_close_to_nothing() -> None:
    model, env = learner("level=none")
    starts = at_first_target(drawn_starts(env.race, 2000)[:2])
    starts[:, :3], starts[:, 3:6], starts[:, 6:10] = env.race.rules.waypoints[-1], 0.0, [1.0, 0.0, 0.0, 0.0]
    starts[:, -1] = len(env.race.rules.sequence) - 1
    starts[1, 2] += 0.5  # too high: that one hovers on
    flights = Flights(env.race, 2)
    room = least_room(flights, model.mean_action, starts, 3)
    assert flights.finished.tolist() == [True, False]
    assert room[0] == OVER
    assert room[1] < OVER


def test_steps_make_room() -> None:
    model, env = learner("curriculum=taught_course", "curriculum.room_begin=0", "curriculum.room_wanted=0.1")
    ascent, starts = ascent_of(model), known_starts(env.race)
    flights = Flights(env.race, len(starts))
    before = least_room(flights, model.mean_action, starts, 25)
    for step in range(40):
        if step % 10 == 0:
            ascent._look()
        ascent._step(3e-3, np.random.default_rng(step))
    after = least_room(flights, model.mean_action, starts, 25)
    assert (after < 0.0).sum() < 0.8 * (before < 0.0).sum()


def test_hard_places_are_those_with_little_room() -> None:
    model, env = learner("curriculum.room_wanted=0.2")
    ascent = ascent_of(model)
    ascent._look()
    assert 100 < len(ascent.hard) < 2000
    room = least_room(Flights(env.race, len(ascent.hard)), model.mean_action, ascent.hard, 25)
    assert (room < 0.2 + NEARLY).all()
    assert (room > -HOPELESS).all()


def test_drawn_starts_are_those_of_no_episode() -> None:
    race = Race(compose([*SMALL, "curriculum=taught_course"]), RaceMode.training(0, 16))
    drawn = drawn_starts(race, 2000)
    assert (drawn[:, -2] == 0.0).all()
    spread = np.abs(drawn[:, :3] - race.rules.start).max(0)
    assert (spread > 1.1).any(), "as wide as training's"  # 1 m, and 30 % more
    race.reset()
    own = records(race.fleet)
    assert not (own[:, None, :2] == drawn[None, :, :2]).all(2).any()


def test_a_step_is_due_every_few_rollouts_between_begin_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    model, env = learner("curriculum.room_begin=0.25", "curriculum.room_end=0.7", "curriculum.room_every=3")
    ascent, looks, steps = ascent_of(model), [], []
    found = at_first_target(drawn_starts(env.race, 2000)[:5]).astype(np.float64)
    monkeypatch.setattr(ascent, "_look", lambda: (looks.append(rollout), ascent.restore_hard(found)))
    monkeypatch.setattr(ascent, "_step", lambda rate, _: steps.append((rollout, rate)))
    for rollout in range(21):
        ascent.begin_rollout(rollout * ROLLOUT)
    assert looks == [5]
    assert [rollout for rollout, _ in steps] == [5, 8, 11]
    rates = np.array([rate for _, rate in steps])
    np.testing.assert_allclose(rates, 1e-3 * 0.1 ** (np.array([0.0, 0.15, 0.3]) / 0.45))


def test_who_needs_no_room_gets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = learner("curriculum.room_every=1")
    ascent = ascent_of(model)
    monkeypatch.setattr(ascent, "_look", lambda: None)
    before = model.parameters.copy()
    ascent.begin_rollout(0)
    np.testing.assert_array_equal(model.parameters, before)


def test_what_is_interrupted_ends_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = compose([*SMALL, "curriculum.room_rate=1e-3", "curriculum.room_begin=0.1", "curriculum.room_every=2"])
    whole = train(config, tmp_path / "whole")
    plain = train(compose(SMALL), tmp_path / "plain")
    weights = [(folder / "policy.safetensors").read_bytes() for folder in (whole, plain)]
    assert weights[0] != weights[1]
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    report = training.Training._report
    for stop in (2, 3, 4, 11):  # before and after the first look, between two steps, and later

        def fail(self: training.Training, final: bool, stop: int = stop) -> None:
            report(self, final)
            if self.model.num_timesteps == stop * ROLLOUT:
                raise RuntimeError("lightning")

        with monkeypatch.context() as patch:
            patch.setattr(training.Training, "_report", fail)
            with pytest.raises(RuntimeError, match="lightning"):
                train(config, tmp_path / "parts")
    parts = train(config, tmp_path / "parts")
    assert (parts / "policy.safetensors").read_bytes() == weights[0]


def place(target: float = 0.0, map_: float = 0.0) -> NDArray[Any]:
    """A hard place as a checkpoint has it."""
    row = np.zeros((1, record_size(len(compose(SMALL).env.waypoints)) + 1))
    row[0, -2:] = map_, target
    return row


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("room/hard", place(target=9)),
        ("room/hard", place(target=-1)),
        ("room/hard", place(map_=1)),
        ("room/hard", place(target=np.nan)),
        ("room/hard", place()[:, 1:]),
        ("room/hard", place()[0]),
        ("room/hard", place().astype(np.float32)),
        ("room_optimizer/0.exp_avg", np.zeros(3, np.float32)),
    ],
)
def test_a_strangers_checkpoint_is_refused(name: str, value: NDArray[Any]) -> None:
    model, env = learner()
    model._setup_learn(ROLLOUT, None)
    ascent_of(model).begin_rollout(0)
    arrays = capture(model, env)
    reinstate(model, env, arrays | {"room/hard": place(target=8)})
    with pytest.raises(TensorFileError, match="not the state of this training"):
        reinstate(model, env, arrays | {name: value})


def test_maps_that_come_and_go_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"curriculum\.room_rate: takes 0 with level\.fresh_steps"):
        compose([*SMALL, "curriculum.room_rate=1e-3", "level=mixed", "level.fresh_steps=1000"])


def test_records_are_put_where_they_were_taken() -> None:
    race = Race(compose([*SMALL, "randomization=full", "randomization.maps=3"]), RaceMode.evaluation(0, np.arange(9)))
    race.reset()
    taken = records(race.fleet)
    other = Race(race.config, RaceMode.evaluation(1, np.arange(9)), race.field)
    put_records(other.fleet, taken)
    np.testing.assert_array_equal(records(other.fleet), taken)
    put_records(other.fleet, nominal_records(race.rules, taken[:, :17], 4))
    assert (other.fleet.steps == 4).all()
