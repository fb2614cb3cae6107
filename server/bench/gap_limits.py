"""What no diagnosis could better: the limits that the records themselves set, beside the campaign's figures.

An oracle who knows shape and noise finds an effect as often as its √NCP says; of two late answers it picks the right
one as often as their difference says; and whoever fits the right model to seven eighths of a record is off on the
rest by what the fit's own covariance says.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from calib_core.effects import library
from calib_core.gap import BY_ITSELF, begin
from calib_core.gap_error import Explanation
from server.bench import Row
from server.bench import gap_campaign as campaign
from server.bench.gap_campaign import Case, as_recording, true_floor
from server.bench.gap_oracle import POWERED, apart, evidence

SUSPECTS = 25
DRAWS = 200
ALARMS = 0.01
"""What the diagnosis' own threshold is designed for."""
PARALLEL = ("bandwidth_lag", "time_offset", "angular_acceleration")


def run() -> Iterator[Row]:
    """The three limits."""
    for strength in (0.2, 0.1):
        yield found(campaign.one_effect(strength, 8), f"one effect at {strength:g}")
    yield decided()
    yield from fitted(list(campaign.one_effect(1.0, 2)))


def found(cases: Iterator[Case], name: str) -> Row:
    """How many the oracle finds, on average over the noise, whatever the shape it looks for."""
    from scipy.special import ndtr, ndtri

    seen = np.array([evidence(case.seed, case.made().effects, case.options) for case in cases])
    least = -float(ndtri(ALARMS / SUSPECTS / 2.0))
    share = 100.0 * float(np.mean(ndtr(seen - least) + ndtr(-seen - least)))
    low = 100.0 * float(np.mean(seen < POWERED))
    told = f"{len(seen)} records, {ALARMS:g} of false alarms over {SUSPECTS} suspects; {low:.0f} % under √NCP 4.2"
    return Row(f"{name}: an oracle finds", share, "%", ours=told)


def decided() -> Row:
    """How often the right one of the late answers is the better one at five times detectability, with an exact rate."""
    from scipy.special import ndtr

    chance, late = [], 0
    for case in campaign.with_rate(5.0, 8):
        (name, size), *_ = case.made().effects.items()
        rivals = [n for n in PARALLEL if n != name] if name in PARALLEL else []
        late += bool(rivals)
        # The right one is best where it beats both; between them lies less than between either and the truth.
        chance.append(
            min((float(ndtr(apart(case.seed, name, n, size, case.options) / 2.0)) for n in rivals), default=1.0)
        )
    told = f"{len(chance)} records, {late} of them late answers, which differ by less than the noise"
    return Row(
        "exact rate, 5 × detectability: an oracle names rightly at most", 100.0 * float(np.mean(chance)), "%", ours=told
    )


def fitted(cases: Sequence[Case]) -> Iterator[Row]:
    """Held-out error ÷ true floor that the right model's own covariance leads to expect, and what it is."""
    expected, measured, rng = [], [], np.random.default_rng(0)
    for case in cases:
        (name,), made = case.effects, case.made()
        if name in BY_ITSELF:
            continue
        axis = str(made.truth["axis"])
        search = begin(as_recording(made), axis, library(), np.random.default_rng(0))
        terms = search.placed([name])
        if "" in terms[0].names:  # a shape of known size is no estimate
            continue
        explanation, floor = Explanation(search.space, terms), true_floor(made)
        measured.append(explanation.error().held_out_rms_dps / floor)
        excess, scatter = _unseen(explanation, floor)
        expected.append(np.sqrt(1.0 + excess + scatter * rng.standard_normal(DRAWS)))
    for name, level in (("median", 0.5), ("95th percentile", 0.95)):
        figure = float(np.quantile(expected, level))
        told = f"{len(expected)} records of one effect at 1; measured on them {np.quantile(measured, level):.4f}"
        yield Row(f"held-out ÷ floor that the right model's covariance lets expect, {name}", figure, "1", ours=told)


def _unseen(explanation: Explanation, floor: float) -> tuple[float, float]:
    """What the parameters' uncertainty brings into the square of blocks that they were not fitted to, in floors²; and
    how that scatters, for it meets the blocks' own noise, of which neighbouring windows share a sixth."""
    folds, gram = explanation.space.folds, explanation.gram
    own = folds.of_time(explanation.middle_s + explanation.space.design.averages.samples.time_s[0])
    inner, size = slice(1, None), gram.scale[1:]
    whole, total, met = gram.matrix[inner, inner] * np.outer(size, size), 0.0, 0.0
    for fold in range(len(folds)):
        columns = explanation.columns[own == fold]
        spread = columns @ np.linalg.inv(whole - gram.parts[fold][inner, inner]) @ columns.T
        neighbours = np.diff(np.flatnonzero(own == fold)) == 1
        total += float(np.trace(spread))
        met += float(np.trace(spread) + np.diag(spread, 1)[neighbours].sum() / 3.0)
    windows = len(explanation.columns)
    return total / windows / floor**2, 2.0 * float(np.sqrt(met)) / windows / floor
