"""The ``srlrace`` command: a thin layer that finds runs, calls the code that works, and words errors.

Heavy imports happen inside the commands, so that help, listings and error messages appear at once.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from srlrace import __version__
from srlrace.completion import (
    COMPLETE,
    complete_experiment,
    complete_override,
    complete_run,
    complete_suite,
    completing,
)
from srlrace.console import fail, out, say, setup_logging
from srlrace.orphans import LEASE, follow_parent
from srlrace.signals import behind

app = typer.Typer(
    name="srlrace",
    help="Train, evaluate and compare policies for time-optimal flight through clutter.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

RunsOption = Annotated[
    Path | None, typer.Option("--runs", metavar="DIR", envvar="SRLRACE_RUNS", help="Where runs live; default ./runs.")
]
RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN", help="A run's id, a unique prefix of it, or its folder.", autocompletion=complete_run
    ),
]
PASS_THROUGH = {"ignore_unknown_options": True, "allow_extra_args": True}


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Show the version and leave.")] = False) -> None:
    if version:
        out.print(f"srlrace {__version__}")
        raise typer.Exit


@app.command(context_settings=PASS_THROUGH)
def train(
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]... [-m]", autocompletion=complete_override)
    ] = None,
    runs: RunsOption = None,
) -> None:
    """Train one run, or several with -m; a finished run is skipped, an interrupted one continues.

    env=forest, reward=no_safety and the like choose a preset, algo.gamma=0.98 and the like one setting.
    -m trains a run for each value: -m seed=0,1,2 hydra/launcher=joblib. --cfg job shows the settings,
    --info how they came about, --config-dir DIR adds presets of yours.
    """
    from srlrace.hydra_bridge import train as train_command

    raise typer.Exit(train_command([*(overrides or []), *(["--runs", str(runs)] if runs else [])]))


@app.command()
def sweep(
    experiments: Annotated[list[str], typer.Argument(metavar="EXPERIMENT...", autocompletion=complete_experiment)],
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="Training seeds; default: the experiment's.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Runs side by side; default: 2 here, all on a cluster.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Training steps of each run, instead of the preset's.")
    ] = None,
    record: Annotated[str, typer.Option(metavar="all|N|none", help="Evaluation episodes to record.")] = "10",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what is to be done.")] = False,
    launcher: Annotated[
        str, typer.Option(metavar="local|slurm|ray", envvar="SRLRACE_LAUNCHER", help="Where.")
    ] = "local",
    detach: Annotated[bool, typer.Option("--detach", help="Return at once, and go on in the background.")] = False,
    cores: Annotated[
        int | None, typer.Option(min=1, max=256, help="Cores and torch threads of a run (other threads, other run).")
    ] = None,
    memory: Annotated[float | None, typer.Option(min=0.5, help="GB of memory of a run on a cluster.")] = None,
    time: Annotated[str | None, typer.Option(metavar="TIME", help="Time limit of a Slurm job.")] = None,
    partition: Annotated[str | None, typer.Option(envvar="SRLRACE_PARTITION", help="Slurm's partition.")] = None,
    slurm: Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE", help="Other options of sbatch.")] = None,
    runs: RunsOption = None,
) -> None:
    """Train and evaluate whatever is missing of the named tables ('paper': the paper's), then report."""
    from srlrace.runs import runs_root
    from srlrace.sweep import command
    from srlrace.sweep.plan import Plan
    from srlrace.sweep.plan import experiments as chosen
    from srlrace.sweep.resources import Resources, read_extra, read_minutes

    plan = Plan(runs_root(runs).absolute(), seeds=seeds, steps=steps, cores=cores, record=check_record(record))
    resources = Resources(cores, memory, read_minutes(time), partition, read_extra(slurm or []))
    command.check_launcher(launcher)
    if detach and not dry_run and launcher != "slurm":
        chosen(experiments)  # what is not there is said here, not in the background
        raise typer.Exit(command.detach(plan.root))
    raise typer.Exit(command.sweep(experiments, plan, launcher, jobs, resources, dry_run))


@app.command("eval")
def evaluate(
    names: Annotated[list[str] | None, typer.Argument(metavar="[RUN]...", autocompletion=complete_run)] = None,
    episodes: Annotated[int, typer.Option(min=1, max=1_000_000, help="Episodes per suite.")] = 1000,
    suite: Annotated[
        list[str] | None,
        typer.Option(
            help="train_map (default), validation, unseen, level1, level2, level3; disturbed: level2-wind5.",
            autocompletion=complete_suite,
        ),
    ] = None,
    record: Annotated[str, typer.Option(metavar="all|N|none", help="Episodes to record.")] = "all",
    snapshots: Annotated[
        bool, typer.Option("--snapshots", help="Fly the policies kept along the training instead, unrecorded.")
    ] = False,
    runs: RunsOption = None,
) -> None:
    """Fly trained policies; the default RUN is the latest finished one."""
    from srlrace.runs import State, find, latest_finished, runs_root
    from srlrace.tables import evaluation_text, learning_table

    root, record = runs_root(runs), check_record(record)
    suites = check_suites(suite or ["train_map"])
    chosen = [find(root, name) for name in names] if names else [latest_finished(root)]
    unfinished = [run.id for run in chosen if run.state is not State.FINISHED]
    if unfinished:
        fail(f"{unfinished[0]} has no policy yet; finish it with: srlrace resume {unfinished[0]}")
        raise typer.Exit(2)
    from srlrace.evaluation import evaluate_run, evaluate_snapshots

    setup_logging()
    for run in chosen:
        for name in suites:
            say(f"{run.id}: {episodes} episodes of {name}")
            if snapshots:
                out.print(learning_table(run.id, evaluate_snapshots(run, episodes, name), episodes))
            else:
                out.print(evaluation_text(run.id, evaluate_run(run, episodes, name, record)))


@app.command()
def report(
    runs: RunsOption = None,
    format: Annotated[
        str | None, typer.Option(metavar="md|csv|tex|html", help="Print tables so, or write a page.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write tables, figures or the page there.")
    ] = None,
) -> None:
    """Show the paper's tables: ours, from the runs at hand, beside the paper's numbers."""
    from srlrace.report.command import report as write_report
    from srlrace.runs import runs_root

    write_report(runs_root(runs), format or "rich", out)


@app.command("runs")
def list_all(
    filter: Annotated[list[str] | None, typer.Option("--filter", metavar="NAME=VALUE", help="Only such runs.")] = None,
    follow: Annotated[bool, typer.Option("--watch", help="Follow them until Ctrl-C.")] = False,
    runs: RunsOption = None,
) -> None:
    """List the runs: id, state, progress, results."""
    from srlrace.runs import list_runs, runs_root
    from srlrace.tables import LONG, filtered, runs_table, runs_text

    root = runs_root(runs)
    if follow:
        from srlrace.watch import watch

        return watch(lambda: filtered(list_runs(root), filter or []))
    chosen = filtered(list_runs(root), filter or [])
    if len(chosen) > LONG:
        out.out(runs_text(chosen), highlight=False)
    elif chosen:
        out.print(runs_table(chosen))
    else:
        say(f"no {'such ' if filter else ''}run in {root}")


@app.command()
def show(run: RunArgument, runs: RunsOption = None) -> None:
    """Show a run's settings, origin and results."""
    from srlrace.runs import find, runs_root
    from srlrace.tables import run_page

    for part in run_page(find(runs_root(runs), run)):
        out.print(part)


@app.command()
def resume(run: RunArgument, runs: RunsOption = None) -> None:
    """Continue an interrupted training; repeating its train command does the same."""
    from srlrace.runs import find, runs_root
    from srlrace.training import resume_run

    raise typer.Exit(resume_run(find(runs_root(runs), run), ["srlrace", *sys.argv[1:]]))


@app.command("replay")
def replay_flights(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN|FILE.mcap]...", autocompletion=complete_run)
    ] = None,
    episode: Annotated[list[int] | None, typer.Option(min=0, help="This episode; may be repeated.")] = None,
    worst: Annotated[bool, typer.Option("--worst", help="The flight that failed first, else the slowest.")] = False,
    crashes: Annotated[bool, typer.Option("--crashes", help="All flights that failed.")] = False,
    overlay: Annotated[int, typer.Option(metavar="N", min=0, help="The first N flights at once.")] = 0,
    reference: Annotated[
        bool, typer.Option("--reference", help="Overlay the time-optimal reference of the track, as a ghost.")
    ] = False,
    reference_file: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="The same, from this recording.")
    ] = None,
    suite: Annotated[
        str,
        typer.Option(
            help="train_map, validation, unseen, level1, level2, level3; disturbed: level2-wind5.",
            autocompletion=complete_suite,
        ),
    ] = "train_map",
    out_file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.html", help="Default: ./<run>-replay.html; FILE.rrd: for Rerun."),
    ] = None,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    runs: RunsOption = None,
) -> None:
    """Write flights as one HTML page that plays in any browser; the default RUN is the latest finished one."""
    from srlrace.replay.command import replay
    from srlrace.replay.reference import Ghost
    from srlrace.replay.select import Wish
    from srlrace.runs import latest_finished, runs_root

    root, [suite] = runs_root(runs), check_suites([suite])
    wish = Wish(tuple(episode or ()), worst, crashes, overlay)
    ghost = Ghost(reference_file) if reference or reference_file else None
    setup_logging()
    path = replay(root, names or [str(latest_finished(root).path)], wish, suite, ghost, out_file)
    out.print(str(path), soft_wrap=True, markup=False)
    if open_page:
        typer.launch(path.resolve().as_uri())


@app.command(context_settings=PASS_THROUGH)
def bound(
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", autocompletion=complete_override)
    ] = None,
    race: Annotated[
        bool, typer.Option("--race", help="On lap tracks: the whole race from rest, no flying lap.")
    ] = False,
    stop: Annotated[bool, typer.Option("--stop", help="End at rest.")] = False,
    restarts: Annotated[int, typer.Option(min=1, max=100, help="First guesses that are followed to the end.")] = 3,
    again: Annotated[bool, typer.Option("--again", help="Solve even what is stored.")] = False,
    demonstrate: Annotated[
        bool, typer.Option("--demonstrate", help="Find the flight that training with curriculum=taught is shown.")
    ] = False,
    escapes: Annotated[
        bool, typer.Option("--escapes", help="Find ways out of hard starts, for curriculum.escape_starts.")
    ] = False,
    out_file: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.mcap", help="Where to write the flight; default: the cache.")
    ] = None,
) -> None:
    """Find the time-optimal reference T_ref of a track, level and quadrotor, and record its flight.

    Settings are those of training: env=forest level=3, quad.thrust_max=6.09, env.passing_radius=0.2 and the like.
    """
    from srlrace.bound.command import bound as find_bound
    from srlrace.bound.command import demonstrate as find_demonstration
    from srlrace.evaluation.escape import show_escapes
    from srlrace.hydra_bridge import compose
    from srlrace.parse import ConfigError

    setup_logging()
    config = compose(overrides or [])
    if demonstrate and escapes:
        raise ConfigError("--demonstrate: goes without --escapes")
    if (demonstrate or escapes) and (race or stop or out_file):
        option = "--demonstrate" if demonstrate else "--escapes"
        raise ConfigError(f"{option}: goes without --race, --stop and --out")
    if demonstrate:
        table, path = find_demonstration(config, again)
    elif escapes:
        table, path = show_escapes(config, again)
    else:
        table, path = find_bound(config, race, stop, restarts, again, out_file)
    out.print(table)
    say(f"wrote {path}")


@app.command()
def bench(
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write the numbers there.")] = None,
) -> None:
    """Measure throughput on this machine: dynamics, full step, training."""
    from srlrace.bench import run

    run(json)


@app.command("export")
def export_policy(
    run: RunArgument,
    to: Annotated[str, typer.Option("--to", metavar="onnx|sb3", help="For deployment, or for Stable-Baselines3.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Default: ./<run>.onnx or ./<run>.zip.")
    ] = None,
    runs: RunsOption = None,
) -> None:
    """Write a trained policy for use elsewhere."""
    from srlrace.runs import find, runs_root

    chosen = find(runs_root(runs), run)
    from srlrace.export import export

    say(f"wrote {export(chosen, to, out_file)}")


@app.command()
def recover(file: Annotated[Path, typer.Argument(metavar="FILE.mcap.part")]) -> None:
    """Turn what an interrupted recording has into a complete file, beside it."""
    from srlrace.recording.recover import recover as recover_file

    try:
        say(f"recovered {recover_file(file)}")
    except (ValueError, OSError) as error:
        fail(str(error))
        raise typer.Exit(2) from None


def check_record(value: str) -> str:
    """Check ``--record``; raises `ConfigError`."""
    from srlrace.parse import ConfigError, show

    if value not in ("all", "none") and not (value.isascii() and value.isdigit() and len(value) < 10):
        raise ConfigError(f"--record: got {show(value)}; takes all, none or a number of episodes")
    return value


def check_suites(names: list[str]) -> list[str]:
    """Check ``--suite``; raises `ConfigError`."""
    from srlrace.suites import check_suite

    return [check_suite(name, "--suite") for name in names]


def main() -> Any:
    """Run the command line; bad input is one line and status 2, a file system that refuses one line and 1."""
    follow_parent()
    if LEASE in os.environ:
        from srlrace.sweep.lease import keep_lease

        keep_lease()
    gc.set_threshold(50_000)  # Hydra makes many small objects that live: collecting them is a tenth of its start
    try:
        words = sys.argv[1:]
        if words[:1] == ["train"] and "--help" not in words and COMPLETE not in os.environ:
            # Typer would hand all of it through; not asking it saves a quarter of the time that an error takes.
            from srlrace.hydra_bridge import train as train_command

            sys.exit(train_command(words[1:]))
        with completing():
            app(prog_name="srlrace")
    except (KeyboardInterrupt, SystemExit) as leaving:
        if behind(leaving, KeyboardInterrupt):  # Typer makes an exit of it
            _leave_stopped()
        raise
    except OSError as error:
        fail(f"{error.strerror}: {error.filename}" if error.filename else str(error))
        sys.exit(1)
    except Exception as error:
        if behind(error, KeyboardInterrupt):
            _leave_stopped()
        if not type(error).__module__.startswith("srlrace."):
            raise  # a bug: it keeps its traceback
        fail(str(error))
        sys.exit(2)


def _leave_stopped() -> None:
    say("stopped; the same command starts anew, and leaves nothing half done")
    sys.exit(130)
