"""Compare models with their float64 reference: inputs, probabilities and verdicts of readings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import COUNT_MAX
from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.contract import SessionInput
from graspd.models.electrodes import Electrodes
from graspd.models.inputs import SPREAD_FLOOR_COUNTS
from graspd.models.judge.grasp_judge import Examined, GraspJudge, Opinion
from graspd.models.runtime import TactileModel
from graspd.models.session_statistics import HORIZON_GRASPS, SessionState
from graspd.models.training.data.datasets import read_table
from graspd.models.training.reports.stability.exact import (
    Exact,
    Reference,
    exact_input,
    exact_softening,
    exact_standard,
)
from graspd.models.training.reports.stability.readings import (
    LIKELY,
    NEVER_JUDGED,
    RANDOM,
    READINGS,
    Counts,
    Raw,
    likely_grasps,
)
from graspd.models.training.reports.stability.row import Row

INPUT_RELATIVE_MAX = 1e-5
"""Largest allowed error of an input, over the largest magnitude in that input."""
P_SLIP_ERROR_MAX = 1e-4
"""Largest allowed error of a probability. Verdicts further from the threshold must not flip."""
THRESHOLD = 0.5
FLOOR_MARGIN = 1e-9
"""Distance of a spread from its floor, counts, within which refused and judged are both right."""
THRESHOLD_PAIRS, BISECTIONS = 12, 40
"""Number of pairs of a stable and a slipping grasp, and of bisections between the two."""


def rows(name: str, data: Path | None = None) -> Iterator[Row]:
    """Yield the rows of a model of the zoo; `data`: folder of the published tables.

    Without onnx the network has no reference, and the rows lack `network`, `p_slip` and `flips`.
    """
    model = TactileModel(zoo.find(name))
    reference = Reference(model.path) if find_spec("onnx") else None
    compared, likely = Comparison(model, reference), likely_grasps(model.contract.seen)
    for case, make in READINGS.items():
        yield compared.row(case, make(likely), never_judged=case in NEVER_JUDGED)
    yield compared.row("next to the threshold", compared.near_threshold(likely))
    if isinstance(model.contract.input, SessionInput):
        seasoned = Comparison(model, reference, seasoned_session(model))
        for case in (LIKELY, RANDOM):
            yield seasoned.row(f"{case}, session of 1e9 grasps", READINGS[case](likely))
    if data is None:
        return
    for table in TABLES:
        grasps = read_table(data / f"{table.name}.csv").of_fingers(model.contract.fingers)
        yield compared.row(f"real grasps, {table.name}", grasps.counts)


class Comparison:
    """Compares one model with its reference."""

    def __init__(
        self,
        model: TactileModel,
        reference: Reference | None,
        state: SessionState | None = None,
    ) -> None:
        """`reference`: of the same file; None: not compared. `state`: session to start from."""
        self._model, self._reference = model, reference
        self._judge = GraspJudge.of(model, THRESHOLD)
        self._standard = None
        if self._judge.session is not None and state is not None:
            self._judge.session.restore(state)
            takes = model.contract.input
            self._standard = (
                exact_standard(takes, state) if isinstance(takes, SessionInput) else None
            )

    def row(self, case: str, counts: Counts, *, never_judged: bool = False) -> Row:
        """Compare on counts (N, fingers, 24); with `never_judged`, none may be judged."""
        with np.errstate(all="ignore"):  # some cases have NaN and infinity in between
            inputs, spreads, answers = self._asked(counts)
            exact, exact_spreads = exact_input(self._model.contract, counts, self._standard)
            said = [self._opinion(reading) for reading in counts]
        sound = _judgeable(spreads)
        differs = sound != _judgeable(exact_spreads)
        near_floor = np.abs(exact_spreads - SPREAD_FLOOR_COUNTS) <= FLOOR_MARGIN
        both = sound & ~differs
        judged = [(opinion, given) for opinion, given in said if opinion.p_slip is not None]
        figures = {
            "readings": float(len(counts)),
            "compared": float(both.sum()),
            "input": _largest(_relative(inputs[both], exact[both])),
            "wrong": float(sum(_is_wrong(opinion) for opinion, _ in said)),
        }
        bounds = {"input": INPUT_RELATIVE_MAX, "wrong": 0.0}
        if never_judged:
            figures["judged"], bounds["judged"] = float(len(judged)), 0.0
        else:
            figures["wrong"] += float((differs & ~near_floor.any(axis=1)).sum())
        if self._reference is not None:
            network = self._network_errors(inputs[both], exact[both], answers[both], judged)
            figures |= network
            bounds |= {"network": P_SLIP_ERROR_MAX, "flips": 0.0}
            if not self._reference.is_stepped:
                # Where the answer jumps, the last bit of the input can change it by a whole step.
                bounds["p_slip"] = P_SLIP_ERROR_MAX
        verdicts = Counter(_said(opinion) for opinion, _ in said)
        return Row(self._model.contract.name, case, figures, bounds, dict(verdicts))

    def near_threshold(self, likely: Raw) -> Raw:
        """Return counts close to the threshold, on both sides, between pairs of `likely` grasps."""
        p_slip = self._asked(likely)[2]
        with np.errstate(invalid="ignore"):
            stable = likely[p_slip < THRESHOLD][:THRESHOLD_PAIRS]
            slips = likely[p_slip >= THRESHOLD][:THRESHOLD_PAIRS]
        edges = [edge for pair in zip(stable, slips, strict=False) for edge in self._edge(*pair)]
        return np.array(edges, dtype=np.uint16).reshape(-1, *likely.shape[1:])

    def _edge(self, stable: Raw, slips: Raw) -> tuple[Raw, Raw]:
        low, high = stable.astype(np.float64), slips.astype(np.float64)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if self._asked(np.rint(middle)[np.newaxis])[2][0] < THRESHOLD:
                low = middle
            else:
                high = middle
        return np.rint(low).astype(np.uint16), np.rint(high).astype(np.uint16)

    def _network_errors(
        self,
        inputs: NDArray[np.float32],
        exact: Exact,
        p_slip: NDArray[np.float64],
        judged: list[tuple[Opinion, NDArray[np.float32]]],
    ) -> dict[str, float]:
        """Return the largest errors of `p_slip`, and `flips`: verdicts that flip beyond the bound.

        `network`: error of the network alone, with the same float32 input. `p_slip`: from the
        counts on. Empty without a reference.
        """
        reference = self._reference
        if reference is None:
            return {}
        same = reference.probabilities(inputs)[:, 1]
        chain = reference.probabilities(exact)[:, 1]
        published = np.array([opinion.p_slip for opinion, _ in judged], dtype=np.float64)
        expected = self._softened([given for _, given in judged])
        network = np.concatenate((abs(p_slip - same), abs(published - expected)))
        right = same if reference.is_stepped else chain
        flips = _flips(p_slip, right) + _flips(published, expected)
        return {
            "network": _largest(network),
            "p_slip": _largest(abs(p_slip - chain)),
            "flips": float(flips),
        }

    def _softened(self, inputs: list[NDArray[np.float32]]) -> NDArray[np.float64]:
        """Return the reference's `p_slip` of these inputs, at a young session's temperature."""
        if not inputs or self._reference is None:
            return np.empty(0)
        answers = self._reference.probabilities(np.array(inputs))
        session = self._judge.session
        if session is None or session.temperature == 1.0:
            return answers[:, 1]
        return exact_softening(answers[:, 0], answers[:, 1], session.temperature, THRESHOLD)

    def _asked(
        self, counts: Counts
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """Return inputs (N, *shape), spreads (N, fingers), and `p_slip` (N,) of the network.

        `p_slip` is NaN where the network is not asked.
        """
        model = self._model
        inputs = np.empty((len(counts), *model.input.shape), dtype=np.float32)
        spreads = np.empty((len(counts), len(model.contract.fingers)))
        p_slip = np.full(len(counts), np.nan)
        for index, reading in enumerate(counts):
            spreads[index] = self._judge.prepare(reading)
            inputs[index] = model.input
            if _judgeable(spreads[index : index + 1])[0]:
                p_slip[index] = model.run()[1]
        return inputs, spreads, p_slip

    def _opinion(self, counts: Counts) -> tuple[Opinion, NDArray[np.float32]]:
        """Return the judge's opinion, and the network input of it. Floats, which no driver gives,
        reach the network as repaired counts do."""
        if counts.dtype == np.uint16:
            raw = counts.astype(np.uint16)
            railed = (raw == 0) | (raw == COUNT_MAX)
            examined = self._judge.examine(raw, railed if railed.any() else None)
        else:
            examined = Examined(counts)
        return self._judge.judge(examined), self._model.input.copy()


def seasoned_session(model: TactileModel) -> SessionState:
    """Return a session after a billion grasps of sensors that drifted.

    Each mean has moved by 0.3 of its spread in the training, each spread has shrunk to 0.8.
    Raises `TypeError` for a model without a session.
    """
    takes, electrodes = model.contract.input, Electrodes(model.contract.seen)
    if not isinstance(takes, SessionInput):
        raise TypeError(f"{model.contract.name} keeps no session")
    mean = np.concatenate((takes.mean, electrodes.centre.ravel()))
    spread = np.concatenate((takes.spread, electrodes.spread.ravel()))
    return SessionState(
        weight=HORIZON_GRASPS,
        grasps=10**9,
        mean=tuple((mean + 0.3 * spread).tolist()),
        squares=tuple((HORIZON_GRASPS * (0.8 * spread) ** 2).tolist()),
    )


def _said(opinion: Opinion) -> str:
    if opinion.p_slip is None:
        return "unknown" if opinion.refusal is None else opinion.refusal.value
    return "slip" if opinion.p_slip >= THRESHOLD else "stable"


def _is_wrong(opinion: Opinion) -> bool:
    """Return True if there is neither a probability nor a reason why there is none."""
    if opinion.p_slip is None:
        return opinion.refusal is None
    return not 0.0 <= opinion.p_slip <= 1.0


def _judgeable(spreads: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return True for readings (N,) that the network judges, by spreads (N, fingers)."""
    return np.array((spreads >= SPREAD_FLOOR_COUNTS).all(axis=1), dtype=np.bool_)


def _relative(inputs: NDArray[np.float32], exact: Exact) -> NDArray[np.float64]:
    """Return each input's largest error over its largest magnitude; (N, ...) to (N,)."""
    axes = tuple(range(1, exact.ndim))
    scale = np.abs(exact).max(axis=axes)
    errors = np.abs(inputs - exact).max(axis=axes) / np.where(scale > 0.0, scale, 1.0)
    relative: NDArray[np.float64] = errors.astype(np.float64)
    return relative


def _flips(p_slip: NDArray[np.float64], right: NDArray[np.float64]) -> int:
    """Count verdicts that differ from those of the reference's `right`; leave out those where
    `right` is within `P_SLIP_ERROR_MAX` of the threshold."""
    other = (p_slip >= THRESHOLD) != (right >= THRESHOLD)
    return int((other & (np.abs(right - THRESHOLD) > P_SLIP_ERROR_MAX)).sum())


def _largest(errors: NDArray[np.float64]) -> float:
    return float(errors.max()) if len(errors) else 0.0
