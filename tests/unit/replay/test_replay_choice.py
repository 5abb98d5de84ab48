"""Which episodes a replay shows."""

from __future__ import annotations

import pandas as pd
import pytest

from srlrace.replay.select import MAX_FLIGHTS, Wish, select
from srlrace.replay.source import check_table
from srlrace.runs import RunError

TABLE = pd.DataFrame(
    [
        (0, 5, "finished", 7.0, None, 9),
        (1, 5, "crashed", None, None, 3),
        (2, 6, "finished", 6.0, None, 9),
        (3, 5, "timeout", None, None, 1),
        (4, 5, "finished", 9.0, None, 9),
        (5, 5, "finished", 8.0, None, 9),
        (6, 5, "crashed", None, None, 1),
    ],
    columns=["episode", "map", "outcome", "time_s", "lap_time_s", "gates_passed"],
)
CLEAN = TABLE[TABLE["outcome"] == "finished"].reset_index(drop=True)


def test_default_is_the_median_with_the_extremes_and_failures() -> None:
    chosen = select(TABLE, Wish())
    assert chosen.shown == (0,)  # 6, 7, 8, 9 s: the lower median
    assert chosen.episodes == (0, 2, 4, 1, 3, 6)
    assert "episode 0, of median time among 4 finished" in chosen.why


def test_laps_are_ranked_by_their_lap() -> None:
    laps = CLEAN.assign(lap_time_s=[1.0, 4.0, 2.0, 3.0])
    assert select(laps, Wish()).episodes == (4, 0, 2)


def test_worst_gets_least_far_else_is_slowest() -> None:
    assert select(TABLE, Wish(worst=True)).episodes == (3,)
    assert select(CLEAN, Wish(worst=True)).episodes == (4,)


def test_crashes_are_all_that_failed() -> None:
    chosen = select(TABLE, Wish(crashes=True))
    assert (chosen.episodes, chosen.shown) == ((1, 3, 6), (1,))
    with pytest.raises(RunError, match="none of 4 episodes failed"):
        select(CLEAN, Wish(crashes=True))


def test_overlay_keeps_to_one_map() -> None:
    chosen = select(TABLE, Wish(overlay=4))
    assert chosen.episodes == chosen.shown == (0, 1, 3, 4)


def test_nothing_finished_shows_a_failure() -> None:
    failed = TABLE[TABLE["outcome"] != "finished"]
    assert select(failed, Wish()).shown == (1,)


def test_named_episodes_exist() -> None:
    assert select(TABLE, Wish(episodes=(4, 2, 4))).episodes == (4, 2)
    with pytest.raises(RunError, match="episode 17: there are 7 episodes, 0 to 6"):
        select(TABLE, Wish(episodes=(17,)))


def test_wishes_exclude_each_other() -> None:
    with pytest.raises(RunError, match="--episode and --worst exclude each other"):
        Wish(episodes=(1,), worst=True)
    with pytest.raises(RunError, match="at most"):
        Wish(overlay=MAX_FLIGHTS + 1)


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [("time_s", ["soon"], "text where numbers"), ("episode", [-1], "wrongly"), ("map", [None], "text where numbers")],
)
def test_tables_of_strangers_are_checked(column: str, values: list[object], message: str) -> None:
    with pytest.raises(RunError, match=message):
        check_table(TABLE[:1].assign(**{column: values}), "theirs")
    with pytest.raises(RunError, match="no table of episodes"):
        check_table(TABLE.drop(columns=column), "theirs")
