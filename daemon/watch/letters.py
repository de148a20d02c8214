"""Big letters for a verdict: readable from across the room, also without colour."""

from __future__ import annotations

HEIGHT = 5
"""Rows of a letter; each text line shows two."""
_LETTERS = {
    "A": ".##. #..# #### #..# #..#",
    "B": "###. #..# ###. #..# ###.",
    "E": "#### #... ###. #... ####",
    "I": "### .#. .#. .#. ###",
    "K": "#..# #.#. ##.. #.#. #..#",
    "L": "#... #... #... #... ####",
    "N": "#...# ##..# #.#.# #..## #...#",
    "O": ".##. #..# #..# #..# .##.",
    "P": "###. #..# ###. #... #...",
    "S": ".### #... .##. ...# ###.",
    "T": "##### ..#.. ..#.. ..#.. ..#..",
    "U": "#..# #..# #..# #..# .##.",
    "W": "#...# #...# #.#.# ##.## #...#",
}


def big(word: str, *, ascii_only: bool) -> list[str]:
    """Lines of the word: three of half blocks, or five of `#` where there is only ASCII."""
    letters = [_LETTERS[letter].split() for letter in word.upper()]
    rows = [" ".join(letter[row] for letter in letters) for row in range(HEIGHT)]
    if ascii_only:
        return [row.replace(".", " ") for row in rows]
    rows.append("." * len(rows[0]))
    blocks = {"..": " ", "#.": "▀", ".#": "▄", "##": "█"}
    pairs = zip(rows[::2], rows[1::2], strict=True)
    return [
        "".join(blocks[(a + b).replace(" ", ".")] for a, b in zip(upper, lower, strict=True))
        for upper, lower in pairs
    ]
