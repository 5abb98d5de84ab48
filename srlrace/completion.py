"""What the shell offers on <TAB>; a completion never raises and imports nothing heavy."""

from __future__ import annotations

import io
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from functools import wraps

COMPLETE = "_SRLRACE_COMPLETE"  # Typer's variable: set while a shell asks

Completer = Callable[[str], list[str]]


def quietly(complete: Callable[[str], Iterable[str]]) -> Completer:
    """A completer that offers nothing where the plain one would raise."""

    @wraps(complete)
    def safe(incomplete: str) -> list[str]:
        with suppress(Exception):
            return [word for word in complete(incomplete) if word.startswith(incomplete)]
        return []

    return safe


@quietly
def complete_override(incomplete: str) -> Iterable[str]:
    """``env=`` and other names; after the equals sign, what the setting takes."""
    from srlrace.catalogue import GROUPS, SETTINGS, choices

    key, equals, _ = incomplete.partition("=")
    if not equals:
        return [f"{name}=" for name in (*GROUPS, *SETTINGS)]
    if key in GROUPS:
        return [f"{key}={name}" for name in choices(key)]
    setting = SETTINGS[key]
    values = ("true", "false") if setting.kind is bool else setting.field.metadata["choices"]
    return [f"{key}={value}" for value in values]


@quietly
def complete_run(incomplete: str) -> Iterable[str]:
    """Ids of runs in the usual place."""
    from srlrace.runs import list_runs, runs_root

    return [run.id for run in list_runs(runs_root())]


@quietly
def complete_experiment(incomplete: str) -> Iterable[str]:
    """Names of experiment files, and ``paper``."""
    from srlrace.confdir import conf_dir

    return [*sorted(path.stem for path in (conf_dir() / "experiment").glob("*.yaml")), "paper"]


@quietly
def complete_suite(incomplete: str) -> Iterable[str]:
    """Names of evaluation suites."""
    from srlrace.suites import suite_names

    return suite_names()


@contextmanager
def completing() -> Iterator[None]:
    """Mend bash's habit of breaking words at ``=``: ask with the whole word, answer with the part after it."""
    if os.environ.get(COMPLETE) != "complete_bash":
        yield
        return
    words, index, has_equals = rejoin(os.environ.get("COMP_WORDS", ""), os.environ.get("COMP_CWORD", "0"))
    os.environ["COMP_WORDS"], os.environ["COMP_CWORD"] = words, index
    answers = io.StringIO()
    try:
        with redirect_stdout(answers):
            yield
    finally:
        lines = answers.getvalue().splitlines(keepends=True)
        sys.stdout.write("".join(line.partition("=")[2] if has_equals else line for line in lines))


def rejoin(words: str, index: str) -> tuple[str, str, bool]:
    """Join ``key = value`` back into ``key=value`` up to the word under the cursor; whether that one has a ``=``."""
    try:
        parts, cursor = shlex.split(words), int(index)
    except ValueError:
        return words, index, False
    joined: list[str] = []
    for word in (*parts[: cursor + 1], *[""][: cursor + 1 - len(parts)]):
        glue = bool(joined) and (word == "=" or joined[-1].endswith("="))
        if glue:
            joined[-1] += word
        else:
            joined.append(word)
    return shlex.join(joined), str(len(joined) - 1), "=" in joined[-1]
