"""The shipped track and level files compose: a track brings its level, and the command line wins."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

CONF = Path(__file__).parents[3] / "conf"


@pytest.fixture(scope="module")
def composed(tmp_path_factory: pytest.TempPathFactory):
    """Compose with a primary config of the two groups only: level before env, which overrides it."""
    folder = tmp_path_factory.mktemp("conf")
    (folder / "main.yaml").write_text("defaults: [_self_, level: none, env: forest]\n")
    for group in ("env", "level"):
        (folder / group).symlink_to(CONF / group)
    with initialize_config_dir(str(folder), version_base=None):
        yield lambda *overrides: compose("main", overrides=list(overrides))


@pytest.mark.parametrize(
    ("overrides", "track", "level"),
    [
        ((), "forest", "2"),
        (("env=split_s",), "split_s", "split_s"),
        (("env=split_s_cpc",), "split_s_cpc", "none"),
        (("level=none",), "forest", "none"),
        (("level='3'",), "forest", "3"),
        (("env=split_s", "level=none"), "split_s", "none"),
        (("level=mixed", "env=split_s_cpc"), "split_s_cpc", "mixed"),
    ],
)
def test_default_and_explicit_level(composed, overrides, track, level) -> None:
    config = OmegaConf.to_container(composed(*overrides))
    assert (config["env"]["name"], config["level"]["name"]) == (track, level)


@pytest.mark.parametrize("path", sorted([*CONF.glob("env/*.yaml"), *CONF.glob("level/*.yaml")]), ids=lambda p: p.stem)
def test_files_say_how_to_run_them(path: Path) -> None:
    text = path.read_text()
    assert text.startswith("# ")
    assert "# srlrace train " in text
