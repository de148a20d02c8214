"""Grasps of another day, judged one after the other as the daemon does, without labels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX
from graspd.models.electrodes import Electrodes
from graspd.models.inputs import builder, raw_features
from graspd.models.session_statistics import SessionStatistics, is_odd
from graspd.models.training.arrays import Bools, Floats, Ints, Numbers
from graspd.models.training.data.datasets import Grasps
from graspd.models.training.fitting.standards import NONE, RUNNING, RUNNING_SORTED, Standards
from graspd.models.training.fitting.standards import PRIOR_GRASPS as PRIOR
from graspd.models.training.fitting.trained import Trained
from graspd.models.training.systems.registry import SessionFeatures

CALIBRATED_FROM = 20
"""Grasps from which a session counts as calibrated; more gain at most two points."""

Judged = tuple[dict[str, Floats], dict[str, Bools], dict[str, Ints]]
"""By variant: log-odds of slip, refusals, and age of the session at each grasp."""


def judged_days(trained: Trained, grasps: Grasps, test: Ints, seed: int) -> Judged:
    """Judge the rows `test` of grasps with a trained system; each table is a new session.

    A session system judges each table in random order, and again object by object. Refused grasps,
    which the daemon calls `unknown`, have margins too.
    """
    takes, fingers = trained.system.input, len(trained.system.fingers)
    counts, table_of = grasps.counts[test], grasps.table_of[test]
    if not isinstance(takes, SessionFeatures):
        day = Day(trained)
        looks = [day.look(reading) for reading in counts]
        inputs, _ = builder(takes, fingers).build_batch(np.stack([look[0] for look in looks]))
        return {NONE: trained.fitted.margins(inputs)}, {NONE: ~np.array([o[1] for o in looks])}, {}
    random = np.random.default_rng(seed)
    judged: Judged = {}, {}, {}
    for variant in (RUNNING, RUNNING_SORTED):
        days = [SessionDay(trained) for _ in grasps.files]
        margins, refused = np.empty(len(test)), np.empty(len(test), np.bool_)
        ages = np.empty(len(test), np.int64)
        order = random.permutation(len(test))
        if variant == RUNNING_SORTED:
            order = by_object(random, order, np.array(grasps.objects)[test[order]])
        for place in order.tolist():
            day = days[table_of[place]]
            ages[place] = day.session.grasps
            margins[place], refused[place] = day.judge(counts[place])
        judged[0][variant], judged[1][variant], judged[2][variant] = margins, refused, ages
    return judged


def by_object(random: np.random.Generator, rows: Ints, objects: NDArray[np.str_]) -> Ints:
    """Return rows (N,) sorted by their `objects` (N,), which come in random order.

    The rows of each object stay in the order given.
    """
    several = random.permutation(np.unique(objects))
    return np.concatenate([rows[objects == name] for name in several])


class Day:
    """The daemon's `Plausibility`, for readings with no fault."""

    def __init__(self, trained: Trained) -> None:
        self.electrodes = Electrodes(trained.seen())
        self._sound = np.zeros(self.electrodes.centre.shape, np.bool_)

    def look(self, counts: Numbers, session: Standards | None = None) -> tuple[Numbers, bool, bool]:
        """Return repaired counts (fingers, 24), and two bools: judged, learned by a session.

        `session`: mean and spread of the session's counts.
        """
        now = session or Standards(self.electrodes.centre, self.electrodes.spread)
        scale = self.electrodes.spread / now.spread
        values = self.electrodes.centre + (counts.astype(np.float64) - now.mean) * scale
        found = self.electrodes.examine(values, self._sound, in_session=session is not None)
        if found.values is not values:
            expected = now.mean + (found.values - self.electrodes.centre) / scale
            counts = np.where(found.implausible, np.clip(expected, 0.0, COUNT_MAX), counts)
        return counts, found.seen, found.learned


class SessionDay:
    """A new session, like the daemon's `SessionCalibration`."""

    def __init__(self, trained: Trained) -> None:
        takes = trained.system.input
        if trained.standards is None or not isinstance(takes, SessionFeatures):
            raise ValueError(f"{trained.system.name} has no sessions")
        self._fitted, self._clip = trained.fitted, takes.clip
        self._day, prior = Day(trained), trained.standards.prior
        self._training = Standards(self._day.electrodes.centre, self._day.electrodes.spread)
        self._features = len(prior.mean)
        mean = np.concatenate((prior.mean, self._training.mean.ravel()))
        spread = np.concatenate((prior.spread, self._training.spread.ravel()))
        self.session = SessionStatistics(mean, spread, PRIOR)
        self.inputs = np.zeros(self._features, np.float32)
        """Inputs of the network, (features,), for the grasp that was judged last."""

    def look(self, counts: Numbers) -> tuple[Numbers, bool, bool]:
        """Return the result of `Day.look`; the session may be odd."""
        mean, spread = (
            values[self._features :].reshape(counts.shape)
            for values in (self.session.mean, self.session.spread)
        )
        training = self._training.mean, self._training.spread
        young = self.session.grasps < CALIBRATED_FROM
        odd = is_odd(mean, spread, *training, enough=not young)
        repaired, seen, learned = self._day.look(counts, Standards(mean, spread))
        return repaired, seen and not odd, learned or odd or young

    def judge(self, counts: Numbers) -> tuple[float, bool]:
        """Return log-odds of slip and True if refused; then learn from the grasp."""
        repaired, seen, learned = self.look(counts)
        features = slice(self._features)
        by = Standards(self.session.mean[features], self.session.spread[features])
        inputs = by.apply(raw_features(repaired if seen else counts)[np.newaxis], self._clip)
        self.inputs = inputs[0]
        (margin,) = self._fitted.margins(inputs).tolist()
        if learned:
            values = np.concatenate((raw_features(counts), counts.ravel().astype(np.float64)))
            self.session.observe(values, slip=margin > 0.0 if seen else None)
        return margin, not seen
