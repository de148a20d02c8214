"""Places of the 24 electrodes of a BioTac SP in a tactile image (paper, section II-A)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Layout:
    """Pixel of each electrode E1..E24 in the image of one finger."""

    name: str
    rows: tuple[int, ...]
    columns: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image, pixels."""
        return max(self.rows) + 1, max(self.columns) + 1


def _layout(name: str, rows: str, columns: str) -> Layout:
    return Layout(name, tuple(map(int, rows.split())), tuple(map(int, columns.split())))


D1 = _layout(
    "D1",
    "0 1 4 5 6 7 8 9 10 11 0 1 4 5 6 7 8 9 10 11 2 3 3 5",
    "1 2 0 1 3 0 1 4 2 1 9 8 10 9 7 10 9 6 8 9 5 4 6 5",
)
"""Layout of 12 x 11 pixels that keeps the sensor's arrangement; the paper's best."""

D2A = _layout(
    "D2a",
    "0 1 2 2 3 3 4 4 5 5 0 1 2 2 3 3 4 4 5 5 0 1 1 2",
    "4 4 4 3 3 4 4 3 3 4 0 0 0 1 1 0 0 1 1 0 2 3 1 2",
)
"""Layout of 6 x 5 pixels. Two tables of D2 were released; the paper does not name its own."""

D2B = _layout(
    "D2b",
    "0 0 2 2 3 3 4 4 5 5 0 0 2 2 3 3 4 4 5 5 0 1 1 2",
    "4 3 4 3 3 4 4 3 3 4 0 1 0 1 1 0 0 1 1 0 2 3 1 2",
)
"""Layout of 6 x 5 pixels, the other table of D2."""

D3 = _layout(
    "D3",
    "0 0 1 1 2 2 2 3 3 3 0 0 1 1 2 2 2 3 3 3 0 1 1 2",
    "6 5 6 5 4 6 5 4 5 6 0 1 0 1 2 0 1 2 1 0 3 4 2 3",
)
"""Layout of 4 x 7 pixels."""

LAYOUTS = {layout.name: layout for layout in (D1, D2A, D2B, D3)}
