"""Failures of every kind: small versions in the default tests, the full ones with ``make soak``."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator

import pytest
import zygote as zygotes
from invariants import results
from kinds import words
from soak import SOAKED


@pytest.fixture(scope="session")
def zygote() -> Iterator[zygotes.Zygote]:
    running = zygotes.Zygote()
    yield running
    running.close()


@pytest.fixture(scope="session")
def much() -> Callable[[int, int], int]:
    """How much of something to do: so much in the default tests, so much in the soak."""
    return lambda small, full: full if SOAKED else small


@pytest.fixture
def chance(record_property: Callable[[str, object], None]) -> random.Random:
    """Other moments in every run of a test, but the same in CI; ``SRLRACE_SEED`` repeats those of one run."""
    drawn = 0 if os.environ.get("CI") else random.SystemRandom().randrange(10**6)
    seed = int(os.environ.get("SRLRACE_SEED") or drawn)
    record_property("SRLRACE_SEED", seed)
    return random.Random(seed)


@pytest.fixture(scope="session")
def undisturbed(zygote: zygotes.Zygote, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, str]]:
    """The results of a run of each kind that nothing disturbed."""
    known: dict[str, dict[str, str]] = {}

    def get(kind: str) -> dict[str, str]:
        if kind not in known:
            place = tmp_path_factory.mktemp(kind)
            runs = ["--runs", str(place / "runs")]
            ended = zygote.run(["train", *words(kind), *runs], ["eval", "--episodes", "12", *runs], out=place / "out")
            assert ended.status == 0, (place / "out").read_text()
            [folder] = (place / "runs").iterdir()
            known[kind] = results(folder)
        return known[kind]

    return get


@pytest.fixture(scope="session")
def say(pytestconfig: pytest.Config) -> Callable[[str], None]:
    """Tell a figure of the soak on the terminal."""
    reporter = pytestconfig.pluginmanager.get_plugin("terminalreporter")
    captures = pytestconfig.pluginmanager.get_plugin("capturemanager")

    def tell(text: str) -> None:
        if SOAKED and reporter:
            with captures.global_and_fixture_disabled():  # else it is said where a test fails, and only there
                reporter.write_line(f"  {text}")

    return tell
