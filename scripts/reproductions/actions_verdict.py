"""The verdict on H4 in words, with the numbers of the run. The words are of the committed record's ten seeds."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from beliefgym.scripts.reproductions.actions_methods import (
    CONDITIONAL,
    CONDITIONAL_IS,
    DECISION,
    HEADLINE,
    NAIVE,
    ORDINARY,
    PLAIN,
    TRUNCATED,
    UNWEIGHED,
    WEIGHTED,
    geometric,
    paired,
    shown,
)

Found = Mapping[tuple[str, float], list[dict[str, Any]]]
BINS = (0.0, 100.0, 1000.0, 3000.0, np.inf)  # of effective samples


def verdict(found: Found, levels: Mapping[str, tuple[float, ...]]) -> list[str]:
    """Paragraphs.

    Args:
        found: (world, level of A) -> results of its seeds. levels: of each world, that of strong feedback last.
    """
    strong = {world: found.get((world, of[-1]), []) for world, of in levels.items()}
    if not all(strong.values()):
        return ["No verdict: a world has no results."]

    def error(world: str, name: str, b: str = "blind") -> str:
        form = ".1f" if world == "swing" else ".3f"
        excess = [one["methods"][name]["excess"][b][HEADLINE] for one in strong[world]]
        return shown(world, excess).text(form)

    def away(world: str, name: str, key: str = "do") -> str:
        return geometric(
            one["methods"][name][key] / one["methods"][name]["gap"] for one in strong[world]
        ).text(".2f")

    def over(world: str, better: str, worse: str, measure: str = "do") -> str:
        return paired(strong[world], better, worse, measure).text(".2f")

    def few(k: str, name: str) -> str:
        values = [one["few"][k][name]["excess"]["blind"][HEADLINE] for one in strong["cancelling"]]
        return shown("cancelling", values).text(".2f")

    drift = float(np.mean([one["drift"]["opposite"] for one in strong["output"]]))
    return [
        "**Verdict on H4: it holds as far as effective samples last, and it is needed less often than the thesis "
        "expects.** Importance weights bring the belief towards the one of Eqs. 4.12 to 4.14, by a third to a half "
        "of the way under strong feedback. To simulate another policy, which is what they are proposed for, they are "
        "needed only where the belief of A's future forgets the state; and there a belief that also holds the "
        "actions to come does without them. Numbers here are under strong feedback, forecasts 5 steps ahead, errors "
        "over the exact predictor's.",
        "**One step of F needs no weights.** m_{t+1} = F(m_t, x_t, a_t) is conditional on the action, and x_{t+1} "
        "given h_t, x_t and a_t does not depend on who chose a_t. Where m_t is a sufficient statistic of h_t, a "
        "filter without weights simulates any actions: with feedback of the observation its error is "
        f"{error('output', UNWEIGHED)} of the exact predictor's under blind actions and "
        f"{error('output', UNWEIGHED, 'opposite')} under opposite feedback, {drift:.1f} nats a step away. So does "
        f"the naive joint model of Eq. 4.6 ({error('output', NAIVE)}), stepped along with the actions that are "
        "given: the thesis says that it could not. Weights are a cost there: ordinary IS "
        f"{error('output', ORDINARY)}, WIS {error('output', WEIGHTED)}, per decision {error('output', DECISION)}, "
        f"truncated {error('output', TRUNCATED)}.",
        "**What the belief itself says does need them.** Without weights its observations to come are A's, and not "
        f"those of do(): {away('output', UNWEIGHED, 'own')} from the one and {away('output', UNWEIGHED)} from the "
        f"other. WIS brings the second to {away('output', WEIGHTED)}, per-decision WIS to "
        f"{away('output', DECISION)}, truncated to {away('output', TRUNCATED)}, ordinary IS to "
        f"{away('output', ORDINARY)}; ConditionalPSIM with weights to {away('output', CONDITIONAL_IS)}, without any "
        f"to {away('output', CONDITIONAL)}. On the ring per-decision WIS comes to {away('ring', DECISION)}, "
        f"truncated to {away('ring', TRUNCATED)}, from {away('ring', UNWEIGHED)}.",
        "**Where the belief is not sufficient, simulation needs them too.** Feedback that cancels all that it "
        "foresees leaves nothing of the state in A's future, so that a belief of that future forgets the state, and "
        f"F takes an action, which knows it, for a cause of what it answered: error {error('cancelling', UNWEIGHED)} "
        f"without weights. Truncated per-decision WIS repairs that to {error('cancelling', TRUNCATED)}, without "
        f"truncation {error('cancelling', DECISION)}, WIS {error('cancelling', WEIGHTED)}, ordinary IS "
        f"{error('cancelling', ORDINARY)}, ConditionalPSIM with weights {error('cancelling', CONDITIONAL_IS)} and "
        f"without {error('cancelling', CONDITIONAL)}. The best there is the naive joint model, "
        f"{error('cancelling', NAIVE)}: the actions to come in its belief tell what the observations to come do not. "
        f"With too few observations in the belief (k = 2 for three states) it is {few('2', UNWEIGHED)} without "
        f"weights, {few('2', TRUNCATED)} with truncated ones, {few('2', CONDITIONAL_IS)} for ConditionalPSIM with "
        "weights; with k = 1 no action lies inside the belief, weights are all 1 and nothing helps "
        f"({few('1', TRUNCATED)}).",
        "**When weights fail.** Distance from do() by effective samples, over all worlds, strengths of feedback and "
        f"k; 1 is what no weights give. {_bins(found)} Below about a hundred, whole-test weights are as good as "
        "none. Truncated weights count more samples, but what is cut off is a bias towards A: at the same number "
        "they are further away. ConditionalPSIM gets on with fewer on the linear worlds (the ring is left out of its "
        "numbers), since only a few coefficients are weighed. With normal actions and the marginal reference the "
        "weight of even one action has a finite variance only while the variance of recorded actions is below 4/3 of "
        "the exploration's; with feedback of the observation it is 1.3 at gain 0.5 and 1.8 at 1, with feedback that "
        "cancels 1.4 and 2.5.",
        "**Which weights.** Ratio of distances from do(), over the same k: WIS over ordinary IS "
        f"{over('output', WEIGHTED, ORDINARY)} (cancelling {over('cancelling', WEIGHTED, ORDINARY)}, ring "
        f"{over('ring', WEIGHTED, ORDINARY)}); per decision over whole tests {over('output', DECISION, WEIGHTED)} "
        f"({over('cancelling', DECISION, WEIGHTED)}, {over('ring', DECISION, WEIGHTED)}); truncated over not "
        f"{over('output', TRUNCATED, DECISION)} ({over('cancelling', TRUNCATED, DECISION)}, "
        f"{over('ring', TRUNCATED, DECISION)}). For the excess of forecasts under blind actions truncation makes "
        f"{over('output', TRUNCATED, DECISION, 'blind')} ({over('cancelling', TRUNCATED, DECISION, 'blind')}, "
        f"{over('ring', TRUNCATED, DECISION, 'blind')}) of it.",
        f"**Where it does not help.** On the ring no weights simulate best ({error('ring', UNWEIGHED)}; truncated "
        f"{error('ring', TRUNCATED)}), and ConditionalPSIM is behind even with weights "
        f"({error('ring', CONDITIONAL_IS)}, from do() {away('ring', CONDITIONAL_IS)}): they weigh its effects alone, "
        "and where what an action does depends on the place, A stays in the targets of its second stage. On the "
        f"pendulum the regression itself is what errs, and no weights ({error('swing', UNWEIGHED)} %), WIS "
        f"({error('swing', WEIGHTED)} %), truncated ({error('swing', TRUNCATED)} %) and ConditionalPSIM "
        f"({error('swing', CONDITIONAL)} %) are level, and PSIM that knows of no actions is ahead "
        f"({error('swing', PLAIN)} %, {over('swing', PLAIN, UNWEIGHED, 'blind')} of the squared error without "
        "weights); ordinary IS, whose regression has to answer weights as well, is of no use there "
        f"({error('swing', ORDINARY)} %).",
    ]


def _bins(found: Found) -> str:
    """Geometric mean of the distance from do() by effective samples, for the ways to weigh."""
    points: dict[str, list[tuple[float, float]]] = {}
    for (world, level), results in found.items():
        if world == "swing" or not level:
            continue
        for name in (ORDINARY, WEIGHTED, DECISION, TRUNCATED, CONDITIONAL_IS):
            if name == CONDITIONAL_IS and world == "ring":
                continue
            for one in (result["methods"][name] for result in results):
                points.setdefault(name, []).extend(
                    (held["effective"] * one["n_train"], held["do"] / held["gap"])
                    for held in one["by_k"].values()
                )
    told = []
    for name, each in points.items():
        effective, distance = np.array(each).T
        texts = []
        for low, high in pairwise(BINS):
            inside = distance[(effective >= low) & (effective < high)]
            if len(inside) >= 5:
                limit = f"below {high:,.0f}" if high < np.inf else f"from {low:,.0f} on"
                texts.append(f"{geometric(inside).mean:.2f} {limit}")
        told.append(f"{name}: " + ", ".join(texts))
    return "; ".join(told) + "."
