"""Gives strips colours, so that no two strips side by side have the same one, in a palette that colour-blind readers
tell apart too.
"""

from __future__ import annotations

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray

# Six of Okabe and Ito 2008 with wine red and indigo of Tol 2021: of both, the eight that differ most from each other as
# readers see them who lack one kind of cones
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#882255", "#e69f00", "#332288", "#000000")


def contact(occupied: BoolArray) -> FloatArray:
    """Return by two strips (n, n) the number of cells (rows, columns) that both occupy or where they touch.

    Args:
        occupied: (n, rows, columns) True where a strip lies.
    """
    count = len(occupied)
    padded = np.pad(occupied, ((0, 0), (1, 1), (1, 1)))
    rows, columns = occupied.shape[1:]
    around = np.zeros_like(occupied)
    for down in range(3):
        for right in range(3):
            around |= padded[:, down : down + rows, right : right + columns]
    shared = around.reshape(count, -1).astype(np.float32) @ occupied.reshape(count, -1).astype(np.float32).T
    both: FloatArray = np.asarray(shared + shared.T, np.float64)
    np.fill_diagonal(both, 0.0)
    return both


def colours_of(touching: FloatArray) -> list[str]:
    """Return a colour for each of n strips.

    Strips are coloured in the order of how many colours their neighbours have already (Brélaz 1979). Where more strips
    meet than the palette has colours, those that share the least ground get the same one.

    Args:
        touching: (n, n) how much ground two strips share, from `contact`.
    """
    count = len(touching)
    chosen = np.full(count, -1)
    taken = np.zeros((count, len(PALETTE)))  # ground that a strip shares with strips of each colour
    uses = np.zeros(len(PALETTE))
    degrees = (touching > 0.0).sum(axis=1)
    for _ in range(count):
        open_strips = np.flatnonzero(chosen < 0)
        seen = (taken[open_strips] > 0.0).sum(axis=1)
        strip = int(open_strips[np.lexsort((open_strips, -degrees[open_strips], -seen))[0]])
        colour = int(np.lexsort((np.arange(len(PALETTE)), uses, taken[strip]))[0])
        chosen[strip] = colour
        uses[colour] += 1.0
        taken[:, colour] += touching[:, strip]
    return [PALETTE[colour] for colour in chosen.tolist()]
