"""What an identification found, as a table of text: values, standard deviations, and what the data do not tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pbfd_torch.identify.certainty import Certainty
from pbfd_torch.identify.identification import Identified
from pbfd_torch.identify.levenberg_marquardt import Outcome

CORRELATED = 0.99  # from where on two quantities are told apart by little
SHARE = 0.1  # of a direction: smaller ones are left out of the text
MISFIT = 2.0  # variance of the residual from which on the simulation, or the stated noise, is not believed

_ENDINGS = {
    Outcome.CONVERGED: "converged",
    Outcome.EXHAUSTED: "not converged: out of iterations",
    Outcome.STALLED: "not converged: no step lowers the cost",
    Outcome.BROKEN: "the start cannot be simulated",
}


def report(found: Identified) -> str:
    """One line per quantity, and warnings: for a single fit, or the best one of a batch."""
    one = found.best
    known = one.certainty
    quantities = one.identification.quantities
    values, deviations = one.values.tolist(), known.deviation.tolist()
    rows = [("quantity", "value", "± σ", "unit", "")]
    for k, quantity in enumerate(quantities):
        remark = "" if bool(known.determined[k]) else "not determined"
        digits = 5 if not math.isfinite(deviations[k]) or deviations[k] == 0 else _digits(values[k], deviations[k])
        deviation = f"{deviations[k]:.2g}" if deviations[k] > 0 else "held"
        rows.append((quantity.name, f"{values[k]:.{digits}g}", deviation, quantity.unit, remark))
    widths = [max(len(row[c]) for row in rows) for c in range(4)]
    lines = [
        f"{row[0]:<{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:>{widths[2]}}  {row[3]:<{widths[3]}}  {row[4]}".rstrip()
        for row in rows
    ]
    outcome = _ENDINGS[Outcome(int(one.fit.outcome))]
    lines.append(f"{outcome} after {len(one.fit.history) - 1} iterations; the residual's variance is {float(one.variance):.3g}")
    return "\n".join([*lines, *_warnings(found, one, known)])


def _digits(value: float, deviation: float) -> int:
    """Significant digits down to the second of the deviation."""
    return max(1, min(12, 2 + math.floor(math.log10(max(abs(value), deviation))) - math.floor(math.log10(deviation))))


def _warnings(found: Identified, one: Identified, known: Certainty) -> list[str]:
    names = [quantity.name for quantity in one.identification.quantities]
    lines = []
    if float(one.variance) > MISFIT:
        lines.append("! the residual is larger than the stated noise: the simulation lacks something, or the fit is no global one")
    if int(one.unsolved) > 0:
        lines.append(f"! {int(one.unsolved)} steps of the simulation are unsolved")
    labels = one.identification.labels
    lines += [f"! the data do not determine {_combination(direction.tolist(), labels)}" for direction in known.loose]
    lines += [f"! {name} is at its bound" for k, name in enumerate(labels) if bool(one.fit.held[k])]
    correlation = known.correlation
    for i in range(len(names)):
        lines += [
            f"! {names[i]} and {names[j]} are correlated by {float(correlation[i, j]):+.4f}"
            for j in range(i)
            if abs(float(correlation[i, j])) > CORRELATED and bool(known.determined[i]) and bool(known.determined[j])
        ]
    count = found.fit.cost.numel()
    if count > 1:
        near = int((found.fit.cost <= (1 + 1e-3) * one.fit.cost).sum())
        lines.append(f"{near} of {count} starts ended at this cost")
    return lines


def _combination(weights: Sequence[float], names: Sequence[str]) -> str:
    order = sorted(range(len(weights)), key=lambda k: -abs(weights[k]))
    kept = [k for k in order if abs(weights[k]) > SHARE * abs(weights[order[0]])]
    if len(kept) == 1:
        return names[kept[0]]
    sign = math.copysign(1.0, weights[kept[0]])
    return "the combination " + " ".join(f"{sign * weights[k]:+.2f} ({names[k]})" for k in kept)
