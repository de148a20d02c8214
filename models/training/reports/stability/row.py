"""A row of `graspd report stability`: figures of one case, and their bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one case. A row is broken if a figure is NaN or above its bound."""

    of: str
    """Name of the model or part that was measured."""
    case: str
    figures: dict[str, float]
    bounds: dict[str, float]
    """Largest value that a figure may have, by its name."""
    answers: dict[str, int] = field(default_factory=dict)
    """Number of readings by verdict, or by the reason why they have none."""

    @property
    def broken(self) -> list[str]:
        """Names of the figures that break their bound."""
        return [name for name, most in self.bounds.items() if not self.figures[name] <= most]

    def cells(self) -> list[str]:
        """Return the cells of a line: part, case, figures, answers, what is broken."""
        figures = (f"{name} {value:.3g}" for name, value in self.figures.items())
        answers = (f"{name} {number}" for name, number in self.answers.items())
        broken = [f"{name}: at most {self.bounds[name]:.2g}" for name in self.broken]
        verdict = f"BROKEN {', '.join(broken)}" if broken else "kept"
        return [self.of, self.case, ", ".join(figures), ", ".join(answers) or "-", verdict]

    def to_builtins(self) -> dict[str, object]:
        """Return the row for JSON, which has no NaN and no infinity: such a figure is null."""
        figures = {
            name: value if math.isfinite(value) else None for name, value in self.figures.items()
        }
        return {
            "of": self.of,
            "case": self.case,
            "figures": figures,
            "bounds": self.bounds,
            "answers": self.answers,
            "broken": self.broken,
        }
