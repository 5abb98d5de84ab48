"""docs/configure.md: its table of settings is the schema's, and its commands and files do what it says."""

import re
import shlex
from pathlib import Path

import pytest

from srlrace.catalogue import GROUPS, SETTINGS, choices
from srlrace.hydra_bridge import compose
from srlrace.overrides import check_arguments
from srlrace.parse import ConfigError

FILE = Path(__file__).parents[2] / "docs" / "configure.md"
PAGE = FILE.read_text()
COMMAND = re.compile(r"^\$ srlrace train ?([^#\n]*)", re.MULTILINE)


def settings_table() -> str:
    """The table of settings in Markdown; running this file as a script brings the page up to date."""
    rows = ["| setting | takes | meaning |", "| --- | --- | --- |"]
    for path, setting in SETTINGS.items():
        takes = setting.takes.replace(", at most 64, beginning with a letter or digit", "")
        rows.append(f"| `{path}` | {takes} | {setting.field.metadata['meaning']} |")
    return "\n".join(rows) + "\n"


def test_the_table_is_the_schema():
    assert PAGE.endswith(settings_table())


def test_every_preset_is_named():
    for group in GROUPS:
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| `{group}` |"))
        assert all(f"`{name}`" in row for name in choices(group))


@pytest.fixture
def files(tmp_path, monkeypatch):
    """The YAML files that the page shows, where its commands expect them."""
    monkeypatch.chdir(tmp_path)
    for name, text in re.findall(r"```yaml\n# (\S+)\n(.*?)```", PAGE, re.DOTALL):
        for path in (Path(name), Path("path/to") / name):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


@pytest.mark.parametrize("words", COMMAND.findall(PAGE))
def test_commands(words, files):
    refused = "forst" in words or "0,0003" in words
    if refused:
        with pytest.raises(ConfigError) as caught:
            compose(shlex.split(words))
        assert f"error: {caught.value}\n" in PAGE
    elif "-m" in words:
        assert check_arguments(shlex.split(words)).options.multirun
    else:
        compose(shlex.split(words))


if __name__ == "__main__":
    FILE.write_text(PAGE[: PAGE.index("| setting | takes |")] + settings_table())
