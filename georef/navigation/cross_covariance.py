"""Compute the joint covariance of the smoothed trajectory's errors at different moments.

In the adjoint form of the smoother (`swath.georef.navigation.filter.smoother`) the smoothed error at node j is s_j =
e_j − P_j λ_j with e_j the filter's own. λ_j is made of innovations, to which no smoothed error is correlated, so that
for j before k

    cov(s_j, s_k) = cov(e_j, s_k) = P_j Ψᵀ (I − Λ_k P_k)        Ψ = A_k … A_j+1        A = ∏ (I − K h) · Φ

with A the transition of the filter's error from a node to the next, over its observed components; for j = k it is the
smoothed covariance P − P Λ P (de Jong and MacKinnon 1988, "Covariances for smoothed estimates in state space models",
Biometrika 75, 601–602; for one moment Bierman 1973). No matrix is inverted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.navigation.filter.error_model import E_ATTITUDE, E_POSITION, MOVED
from swath.georef.navigation.filter.filter import FilterRun
from swath.georef.navigation.filter.strapdown import VELOCITY
from swath.georef.navigation.filter.types import Nodes
from swath.georef.navigation.inputs import NavigationError

ERRORS = 6  # per moment: position north, east, down, then small turns of the body about north, east, down


@dataclass(frozen=True, eq=False)
class ErrorChain:
    """The smoothed errors at k moments, as a chain: its length grows with k, the joint covariance with k².

    Attributes:
        time_ns: (k,) rising.
        left: (k, 6, n) rows of P_j, turned to l.
        ways: (k, n, n) transition of the filter's error from the moment before; the first: from the start.
        right: (k, n, 6) columns of I − Λ_k P_k, turned to l.
    """

    time_ns: Int64Array
    left: FloatArray
    ways: FloatArray
    right: FloatArray

    def __len__(self) -> int:
        """Return the number of moments."""
        return len(self.time_ns)

    def covariance(self) -> FloatArray:
        """Return (6k, 6k) of errors true − smoothed: position in l (m), small turns of the body about n, e, d (rad)."""
        count, size = len(self), self.left.shape[2]
        joint = np.zeros((count, ERRORS, count, ERRORS))
        behind = np.zeros((0, size))
        for k in range(count):
            behind = np.concatenate([behind @ self.ways[k].T, self.left[k]])
            joint[: k + 1, :, k] = (behind @ self.right[k]).reshape(k + 1, ERRORS, ERRORS)
            joint[k, :, :k] = joint[:k, :, k].transpose(2, 0, 1)
            joint[k, :, k] = 0.5 * (joint[k, :, k] + joint[k, :, k].T)
        return joint.reshape(ERRORS * count, ERRORS * count)

    def at(self, time_ns: ArrayLike) -> ErrorChain:
        """Return the chain at the moments nearest to the given times, each once."""
        chosen = _nearest(self.time_ns, time_ns)
        ways = np.empty((len(chosen), *self.ways.shape[1:]))
        begin = 0
        for number, at in enumerate(chosen.tolist()):
            way = np.eye(self.ways.shape[1])
            for step in range(begin, at + 1):
                way = self.ways[step] @ way
            ways[number], begin = way, at + 1
        return ErrorChain(self.time_ns[chosen], self.left[chosen], ways, self.right[chosen])


def error_chain(run: FilterRun, time_ns: ArrayLike) -> ErrorChain:
    """Return the chain at the smoother's nodes nearest to the given times, each once.

    Args:
        run: of the filter, with its nodes; the last one that was smoothed.
        time_ns: in any order, in the run's time: the inertial unit's.

    Raises:
        NavigationError: the run has no nodes.
    """
    n = run.layout.size
    times = np.concatenate([block.time_ns for block in run.nodes]) if run.nodes else np.zeros(0, np.int64)
    if not len(times):
        raise NavigationError("the filter's run has no nodes; use a run that was kept for the smoother")
    wanted = _nearest(times, time_ns)
    chain = ErrorChain(
        times[wanted],
        np.empty((len(wanted), ERRORS, n)),
        np.empty((len(wanted), n, n)),
        np.empty((len(wanted), n, ERRORS)),
    )
    slot, way, information, node = len(wanted), np.eye(n), np.zeros((n, n)), len(times)
    for block, k, closed, seen in _from_the_end(run.nodes, n):
        node -= 1
        if slot and node == wanted[slot - 1]:
            if slot < len(wanted):
                chain.ways[slot] = way
            slot, way = slot - 1, np.eye(n)
            covariance, rows = _unpacked(block.covariance[k], n), _rows_l(block.after[k], n, run.layout.time_offset)
            chain.left[slot] = rows @ covariance
            chain.right[slot] = rows.T - information @ (covariance @ rows.T)
        way = way @ closed
        information = closed.T @ information @ closed + seen
        information = 0.5 * (information + information.T)
    chain.ways[0] = way
    return chain


def _nearest(times: Int64Array, wanted: ArrayLike) -> Int64Array:
    """Return rising indices of the nearest times, each once."""
    asked = np.asarray(wanted, dtype=np.int64)
    after = np.clip(np.searchsorted(times, asked), 1, max(len(times) - 1, 1))
    before_is_nearer = asked - times[after - 1] <= np.abs(times[np.minimum(after, len(times) - 1)] - asked)
    return np.unique(np.where(before_is_nearer, after - 1, after)).astype(np.int64)


def _from_the_end(blocks: list[Nodes], n: int) -> Iterator[tuple[Nodes, int, FloatArray, FloatArray]]:
    """Yield each node, last first: block and index in it, A from the node before, and Φᵀ (its own information) Φ."""
    for block in reversed(blocks):
        end = len(block.h)
        for k in range(len(block.time_ns) - 1, -1, -1):
            over, seen = np.eye(n), np.zeros((n, n))
            for i in range(end - 1, block.first[k] - 1, -1):
                h = block.h[i]
                passed = np.eye(n) - np.outer(block.gain[i], h)
                seen = passed.T @ seen @ passed + block.weighed[i, 1] * np.outer(h, h)
                over = over @ passed
            end = int(block.first[k])
            way = np.diag(block.decay[k])
            way[:MOVED] = 0.0
            way[:MOVED, : block.top.shape[2]] = block.top[k]
            yield block, k, over @ way, way.T @ seen @ way


def _unpacked(packed: FloatArray, n: int) -> FloatArray:
    """Expand a lower triangle, stored by rows, to a symmetric matrix (n, n)."""
    full = np.zeros((n, n))
    full[np.tril_indices(n)] = packed
    return full + np.tril(full, -1).T


def _rows_l(state: FloatArray, n: int, late: int) -> FloatArray:
    """Return rows (6, n) that select position and attitude from the errors, turned to l.

    The position is in GNSS's time, r + v τ.
    """
    lat, lon, _ = geodetic_from_e(state[:3])
    rot_l_from_e = rot_e_from_l(lat, lon).T
    rows = np.zeros((ERRORS, n))
    rows[:3, E_POSITION : E_POSITION + 3] = rot_l_from_e
    if late >= 0:
        rows[:3, late] = rot_l_from_e @ state[VELOCITY : VELOCITY + 3]
    rows[3:, E_ATTITUDE : E_ATTITUDE + 3] = rot_l_from_e
    return rows
