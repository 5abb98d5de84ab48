"""The strict parser: what it accepts is exactly what the schema declares, and a run's id follows from it."""

import copy
import dataclasses
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from srlrace.checks import check_memory, memory_estimate
from srlrace.config import (
    Config,
    ConfigError,
    fingerprint,
    load_config,
    method_name,
    parse_config,
    run_id,
    to_dict,
)
from srlrace.hydra_bridge import compose
from srlrace.parse import NAME, settings


@pytest.fixture(scope="module")
def config() -> Config:
    return compose([])


@pytest.fixture
def data(config):
    return copy.deepcopy(to_dict(config))


def put(data, path, value):
    *parents, leaf = path.split(".")
    for parent in parents:
        data = data[parent]
    data[leaf] = value


def refusal(data) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(data)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_round_trip_through_json(config):
    assert parse_config(json.loads(json.dumps(to_dict(config)))) == config


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("algo.learning_rat", 1.0, "algo.learning_rat: no such setting; did you mean learning_rate?"),
        ("algo.gamma", "0.99", "algo.gamma: got '0.99'; takes a number"),
        ("algo.gamma", "0,99", "decimal comma? write 0.99"),
        ("algo.gamma", True, "algo.gamma: got True; takes a number"),
        ("algo.gamma", math.nan, "algo.gamma: got nan"),
        ("algo.ent_coef", math.inf, "algo.ent_coef: got inf"),
        ("algo.gamma", 0.0, "takes a number > 0"),
        ("algo.gamma", 1.01, "<= 1"),
        ("algo.gamma", None, "algo.gamma: got None"),
        ("algo.gamma", 10**400, "algo.gamma"),
        ("algo.n_epochs", 5.0, "takes a whole number"),
        ("algo.n_epochs", False, "takes a whole number"),
        ("algo.activation", "rele", "takes one of relu, tanh, elu; did you mean relu?"),
        ("algo.policy_layers", [], "takes a list of 1 to 16"),
        ("algo.policy_layers", 64, "takes a list of 1 to 16"),
        ("algo.policy_layers", [64, 0], "algo.policy_layers[1]: got 0"),
        ("algo", [], "takes settings name, total_steps"),
        ("env.start", [0, 0], "env.start: got 2 elements; takes a list of 3"),
        ("env.start", [0.0, 0.0, -1.0], "env.start: z is -1, outside the world"),
        ("env.waypoints", [], "takes a list of 1 to 1000"),
        ("env.waypoints", [[0.0, 0.0, 99.0]], "env.waypoints[0]: z is 99, outside the world"),
        ("env.bounds_low", [30.0, 0.0, 0.0], "env.bounds_low: x is 30"),
        ("env.name", "../../etc", "takes a name"),
        ("env.displaced_waypoints", 10, "the track has 9 waypoints"),
        ("env.obstacles", [{"kind": "cone", "center": [0, 0, 1]}], "takes one of sphere, cylinder, box"),
        ("env.obstacles", [{"kind": "box", "center": [0, 0, 1]}], "env.obstacles[0].edge: got 0; a box takes"),
        ("env.obstacles", [{"kind": "sphere", "center": [0, 0, 1], "radius": 1, "edge": 1}], "a sphere has none"),
        ("level.spacings", [{"pitch": 2.0, "jitter": 1.0}], "level.spacings[0].jitter: got 1"),
        ("observation.blocks", ["position", "position"], "position stands twice"),
        ("quad.thrust_max", 1.0, "four rotors lift"),
        ("algo.batch_size", 2400, "nearest: 2500"),
        ("algo.n_envs", 100_000_000, "GiB"),
        ("randomization.maps", 10_000, ""),
        ("name", "a b", "name: got 'a b'"),
        ("seed", -1, "seed: got -1"),
        ("seed", 2**31, "seed: got"),
    ],
)
def test_refuses(data, path, value, words):
    put(data, path, value)
    if path == "randomization.maps":
        put(data, "env.bounds_high", [9000.0, 9000.0, 9000.0])
        words = "level.maps"
    assert words in refusal(data)


def test_missing_settings_are_named_unless_the_schema_has_a_default(data):
    del data["sim"]["substeps"]
    assert parse_config(data).sim.substeps == 8
    del data["algo"]["gamma"]
    assert refusal(data).startswith("algo.gamma: missing; takes a number")


def test_not_a_mapping():
    assert "the configuration: got []" in refusal([])


def test_whole_numbers_become_floats_with_the_same_id(data, config):
    put(data, "algo.ent_coef", 0)
    put(data, "env.start", [-25, 0, 1.12])
    assert parse_config(data) == config
    assert run_id(parse_config(data)) == run_id(config)


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@given(path=st.sampled_from([setting.path for setting in settings(Config)]), value=junk)
def test_any_value_is_either_accepted_or_refused_in_one_line(config, path, value):
    data = copy.deepcopy(to_dict(config))
    put(data, path, value)
    try:
        accepted = parse_config(data)
    except ConfigError as error:
        accepted, words = None, str(error)
    if accepted is None:
        assert words.splitlines() == [words]
        assert path.split(".")[0] in words
    else:
        assert parse_config(json.loads(json.dumps(to_dict(accepted), allow_nan=False))) == accepted


def test_method_names():
    cases = {
        (): "srl",
        ("reward=no_safety",): "no_safety",
        ("observation=rays",): "srl-rays",
        ("baseline=song",): "song",
        ("baseline=song", "observation=blind"): "song-blind",
        ("name=mine", "baseline=song"): "mine",
    }
    assert {words: method_name(compose(words)) for words in cases} == cases


def test_settings_change_the_fingerprint(config):
    assert fingerprint(config) == fingerprint(parse_config(to_dict(config)))
    changed = [
        dataclasses.replace(config, seed=1),
        dataclasses.replace(config, sim=dataclasses.replace(config.sim, substeps=9)),
    ]
    assert len({fingerprint(c) for c in (config, *changed)}) == 3


def test_a_setting_added_later_with_a_default_keeps_old_ids(config):
    """The id hashes what differs from the schema's defaults, so it equals that of a schema without the setting."""
    explicit = dataclasses.replace(config, sim=dataclasses.replace(config.sim, substeps=8))
    data = to_dict(config)
    del data["sim"]["substeps"]
    assert fingerprint(parse_config(data)) == fingerprint(explicit)


def test_ids_are_names_even_with_the_longest_parts(config):
    long = dataclasses.replace(
        config, name="n" * 64, seed=2**31 - 1, env=dataclasses.replace(config.env, name="e" * 64)
    )
    assert NAME.fullmatch(run_id(long))
    assert run_id(config).startswith("forest-srl-s0-")


def test_memory_estimate_grows_with_what_it_names(config):
    bigger = dataclasses.replace(config, algo=dataclasses.replace(config.algo, n_envs=200))
    assert memory_estimate(bigger)["algo.n_envs"] == 2 * memory_estimate(config)["algo.n_envs"]
    samples = 100 * 250
    assert memory_estimate(config)["algo.n_envs"] >= samples * 4 * (34 + 4)  # at least observations and actions
    with pytest.raises(ConfigError, match=r"algo\.n_envs|level\.maps|algo\.batch_size"):
        check_memory(config, 1000)
    roomy = dataclasses.replace(config.curriculum, room_rate=1e-3, room_starts=10**6)
    with pytest.raises(ConfigError, match=r"curriculum\.room_starts: got 1000000, whose memory is about"):
        check_memory(dataclasses.replace(config, curriculum=roomy), 2**30)


@pytest.mark.parametrize(
    "content", [b"", b"[1]", b"{", b'{"seed": NaN}', b"[" * 100_000, b"\xff\xfe", b'{"seed": 1e999}', b"1" * 5_000_000]
)
def test_stored_files_that_are_not_configurations(tmp_path, content):
    path = tmp_path / "config.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"config\.json"):
        load_config(path)


def test_stored_configuration_is_not_read_through_links(tmp_path, config):
    target = tmp_path / "real.json"
    target.write_text(json.dumps(to_dict(config)))
    assert load_config(target) == config
    (tmp_path / "config.json").symlink_to(target)
    with pytest.raises(ConfigError, match="cannot read"):
        load_config(tmp_path / "config.json")


def test_stored_configurations_that_differ_in_the_seed(tmp_path, config):
    """They are parsed once, and every seed is its own; whatever is wrong with one is said of that one."""
    path, text = tmp_path / "config.json", json.dumps(to_dict(config), indent=1)
    line = ' "seed": 0,'
    assert text.count(line) == 1
    for seed in (0, 7, 2**31 - 1):
        path.write_text(text.replace(line, f' "seed": {seed},'))
        assert load_config(path) == dataclasses.replace(config, seed=seed) == parse_config(json.loads(path.read_text()))
    path.write_text(text.replace(line, ' "seed": 1,').replace("\n", "").replace("  ", ""))  # another layout
    assert load_config(path) == dataclasses.replace(config, seed=1)
    for seed in (2**31, "1.5", '"1"', "null", "-1"):
        path.write_text(text.replace(line, f' "seed": {seed},'))
        with pytest.raises(ConfigError, match=f"{path}: seed: got"):
            load_config(path)
    path.write_text(text.replace(line, f'{line}\n "sead": 1,'))
    with pytest.raises(ConfigError, match=f"{path}: sead: no such setting"):
        load_config(path)
