"""The documentation does what it says: links lead somewhere, and code, commands and patches run."""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from srlrace.config import run_id
from srlrace.hydra_bridge import compose
from srlrace.overrides import check_arguments

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
COMMANDED = ("README.md", "docs/start.md", "docs/extend.md", "docs/runs.md", "docs/tracks.md", "docs/clutter.md")
PROGRAMS = ("docs/start.md", "docs/extend.md", "docs/physics.md", "docs/recordings.md")
TINY = ["level=none", "algo.total_steps=100", "algo.n_envs=10", "algo.n_steps=10", "algo.batch_size=50"]


def blocks(page: str, language: str) -> list[str]:
    """The code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


def commands(page: str) -> list[str]:
    """What follows the prompt in the console blocks of a page."""
    lines = (line for block in blocks(page, "console") for line in block.splitlines())
    return [shlex.join(shlex.split(line[2:], comments=True)) for line in lines if line.startswith("$ srlrace")]


def run(words: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder."""
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the pages show, and one evaluated run, of a policy that can do nothing yet."""
    folder = tmp_path_factory.mktemp("docs")
    for block in [*blocks("docs/extend.md", "yaml"), *blocks("docs/tracks.md", "yaml")]:
        if named := re.fullmatch(r"# (\S+\.yaml)\n(.*)", block, re.DOTALL):
            (folder / named[1]).parent.mkdir(parents=True, exist_ok=True)
            (folder / named[1]).write_text(named[2])
    for words in (["train", *TINY], ["eval", "--episodes", "20"]):
        done = run(["-m", "srlrace", *words], folder)
        assert done.returncode == 0, done.stderr
    return folder


# Links and paths


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page: Path) -> None:
    for name in re.findall(r"`((?:srlrace|tests|conf|docs|\.ci)/[\w./-]+)(?<!-v0)`", page.read_text()):
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_page_knows_this_machine(page: Path) -> None:
    text = page.read_text()
    assert str(ROOT) not in text
    assert not re.search(r"(?<![\w.~])/(home|root|tmp|work|Users)/\w", text)


def test_every_page_is_reached_from_the_readme() -> None:
    text = (ROOT / "README.md").read_text()
    assert all(f"(docs/{page.name})" in text for page in PAGES if page.parent.name == "docs")
    assert len(text.splitlines()) <= 150


# Commands


@pytest.mark.parametrize("command", sorted({command for page in COMMANDED for command in commands(page)}))
def test_commands_are_understood(command: str, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train commands compose; of the others, Typer takes every option."""
    monkeypatch.chdir(workplace)
    _, name, *words = shlex.split(command)
    if name == "train" and not {"reward.crowding=-0.1", "observation=rotors"} & set(words):
        if "-m" in words:
            assert check_arguments(words).options.multirun
        else:
            compose([word for word in words if word not in ("--cfg", "job")])
    elif name != "train":
        from typer.main import get_command

        from srlrace.cli import app

        chosen = get_command(app).commands[name]  # type: ignore[attr-defined]
        chosen.make_context(name, list(words))


@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["train", "--cfg", "job", "env=forest", "level=3"]])
def test_cheap_commands(words: list[str], workplace: Path) -> None:
    done = run(["-m", "srlrace", *words], workplace)
    assert done.returncode == 0, done.stderr
    assert "forest" in done.stdout or "Commands" in done.stdout


def test_the_makefile_has_what_the_readme_runs() -> None:
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in ("README.md", "CONTRIBUTING.md"):
        wanted = re.findall(r"^\$ make (\w+)", (ROOT / page).read_text(), re.MULTILINE)
        assert wanted
        assert set(wanted) <= set(targets)


# Code


@pytest.mark.parametrize("page", PROGRAMS)
def test_python_blocks_run(page: str, workplace: Path) -> None:
    """The blocks of a page one after another, as one reads them."""
    (finished,) = (workplace / "runs").glob("forest-*")
    programs = blocks(page, "python")
    texts = programs if page == "docs/extend.md" else ["\n".join(programs)]
    for code in (text.replace("runs/<id>", str(finished)) for text in texts):
        done = run(["-W", "error::DeprecationWarning:__main__", "-c", code], workplace)
        assert done.returncode == 0, f"{code}\n{done.stderr}"


def test_a_weight_can_be_set_in_two_ways(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace)
    preset, setting = (
        compose(["--config-dir", "mine", "reward=careful"]),
        compose(["reward.safety=-0.2", "name=careful"]),
    )
    assert preset.reward.safety == setting.reward.safety == -0.2
    assert run_id(preset).startswith("forest-careful-s0-")
    assert run_id(setting).startswith("forest-careful-s0-")


def apply(patch: str, root: Path) -> None:
    """Apply a patch without line numbers: the old lines of each part must stand in the file exactly once."""
    name, *parts = re.split(r"^@@\n", patch, flags=re.MULTILINE)
    path = root / name.removeprefix("--- ").strip()
    text = path.read_text()
    for part in parts:
        lines = part.splitlines(keepends=True)
        old = "".join(line[1:] or "\n" for line in lines if line[0] != "+")
        new = "".join(line[1:] or "\n" for line in lines if line[0] != "-")
        old, new = old.rstrip("\n"), new.rstrip("\n")
        assert text.count(old) == 1, f"{path.name} has no such place, or several:\n{old}"
        text = text.replace(old, new)
    path.write_text(text)


# One step of a drone held in place (the dynamics needs a compiler), in plain Python: compiling takes half a minute.
STEP = """
import numpy as np
import srlrace.task.step as step
from srlrace.hydra_bridge import compose
from srlrace.task.race import Race, RaceMode
from srlrace.task.reward import TERMS

step.advance_all = lambda *arguments: None
level = "level.obstacles=[{kind: sphere, center: [-20, 5, 2], radius: 0.1}]"
words = ["level=none", level, "curriculum=none", "reward.crowding=-0.25", "--config-dir", "mine", "observation=rotors"]
race = Race(compose(words), RaceMode.training(0, 2))
race.reset()
race.fleet.state[:3] = [[-20, -20], [4.2, 3.8], [2, 2]]
race.fleet.state[13:] = np.array([0, 1, 2, 3])[:, None] * race.rules.hover_thrust
out = race.step(np.zeros((2, 4), np.float32))
print(out.reward_terms[TERMS.index("crowding")].tolist(), out.observation[0, 18:22].round(5).tolist())
"""


def test_patches_apply_and_work(workplace: Path, tmp_path: Path) -> None:
    for name in ("srlrace", "conf"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    shutil.copytree(workplace / "mine", tmp_path / "mine")
    for patch in blocks("docs/extend.md", "diff"):
        apply(patch, tmp_path)
    done = run(["-c", STEP], tmp_path, NUMBA_DISABLE_JIT="1", PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[-0.25, -0.0] [0.0, 1.0, 2.0, 3.0]"


# Structure


COMMANDS = {"cli", "sweep", "tables", "training", "completion", "bench", "replay", "export", "watch"}
FORBIDDEN = {  # package or module: what it must not import when it is itself imported
    "sim": {"world", "task", "learn", "evaluation", "recording", "report", "runs", "hydra_bridge"} | COMMANDS,
    "world": {"task", "learn", "evaluation", "recording", "report", "runs", "hydra_bridge"} | COMMANDS,
    "task": {"learn", "evaluation", "recording", "report", "runs", "hydra_bridge"} | COMMANDS,
    "learn": {"evaluation", "recording", "report", "hydra_bridge"} | COMMANDS,
    "recording": {"sim", "world", "task", "learn", "evaluation", "report", "runs", "hydra_bridge"} | COMMANDS,
    "report": {"sim", "world", "task", "learn", "evaluation", "torch"} | COMMANDS,
    "evaluation": COMMANDS,
}


def imports(path: Path) -> Iterator[str]:
    """The packages that a module imports when it is imported: not inside functions, not for the type checker."""
    waiting: list[ast.AST] = list(ast.parse(path.read_text()).body)
    for node in waiting:
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ClassDef | ast.Try):
            waiting.extend(node.body)


@pytest.mark.parametrize("layer", FORBIDDEN)
def test_dependencies_point_one_way(layer: str) -> None:
    place = ROOT / "srlrace" / layer
    files = sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
    for path in files:
        reached = {name.removeprefix("srlrace.").split(".")[0] for name in imports(path) if name != "srlrace"}
        assert not reached & FORBIDDEN[layer], path.name
