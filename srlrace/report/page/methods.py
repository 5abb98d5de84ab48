"""What stands behind the numbers, in words."""

from __future__ import annotations

from srlrace.report.bootstrap import DRAWS
from srlrace.report.experiments import Paper
from srlrace.report.page.html import Html, tag
from srlrace.report.stats import CONFIDENCE, fisher_exact, wilson

CELLS = """
A cell is filled by finished runs whose configuration equals the row's in everything but the
training seed, a label and the algorithm's settings; runs of different algorithm settings or budgets are never mixed
in a cell. No number in our columns comes from anything but the files of the runs named.
"""
FLIGHTS = """
Policies fly without exploration noise from frozen initial conditions, which no training draws and which are the
same for every method. The crash ratio counts flights that hit an obstacle, left the world or diverged; a timeout is
neither a crash nor a success. Time is the mean over finished flights: the flying lap on tracks with laps, else from
the reset to the last waypoint. A policy that survives only its fastest flights would look fast, so the count of
finished flights stands beside it, and the penalised time, in which a failure counts as the time limit.
"""
INTERVALS = """
All intervals are {level:.0f} %. The training seed is the unit of replication: each seed gives one value, the cell
their mean. The interval is a hierarchical bootstrap ({draws} replicates) over seeds and over flights, or over maps
where several were flown; flights of different seeds are never pooled into one sample. One seed alone gets Wilson's
interval on its count, which says nothing about another training. No crash at all gets the exact interval for zero
of one run's flights. Ablations are paired differences on common seeds.
"""
TRUST = """
Percentile intervals over few seeds are too narrow: in simulation the nominal 95 % covered the truth in 75 to 89 %
of the cases with three seeds, and in 85 to 91 % with five.
"""
REFERENCE = """
T_ref, where it is shown, is the best time that trajectory optimisation found for the same airframe, track and
obstacles in a slightly relaxed model (no rotor lag, no hold of 20 ms). It is a best known value and no proof of
optimality. The gap is how much slower the mean time is; on unseen maps each flight is held against T_ref of its
own map. References begin at rest at the nominal start, flights up to a metre and 1 m/s away from it.
"""
BEARING = """
The paper says that every test has 1000 flights; its crash ratios fit only multiples of {n}. With {n} flights, 0 %
has an interval of 0 to {high:.0f} %, and 1 of {n} against 0 of {n}, its ablation of the safety reward, is no
evidence of an effect (Fisher's exact test, p = {p:g}).
"""
COMPARING = """
The paper prints neither the mass nor the thrust of its quadrotor, neither the seeds nor the spread of its results,
and shortest possible times depend on the ratio of thrust to weight. No single ratio makes both of its times, in the
Forest and on Split-S, near optimal. Our times beside the paper's therefore say little about the learning; rows of
one table, which share algorithm, budget, resets and initial conditions, can be compared.
"""


def methods_html(paper: Paper) -> Html:
    """Return how the numbers came about and what they can bear, ours and the paper's."""
    n = paper.episodes
    bearing = BEARING.format(n=n, high=100 * wilson(0, n).high, p=fisher_exact((1, n), (0, n)))
    paragraphs = {
        "Cells": CELLS,
        "Flights": FLIGHTS,
        "Intervals": INTERVALS.format(level=100 * CONFIDENCE, draws=DRAWS),
        "How far to trust them": TRUST,
        "The time-optimal reference": REFERENCE,
        "What the paper's numbers can bear": bearing,
        "Comparing with the paper": COMPARING,
    }
    return tag(
        "div", *(tag("p", tag("strong", f"{title}. "), " ".join(words.split())) for title, words in paragraphs.items())
    )
