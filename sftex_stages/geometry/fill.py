"""Smooth continuation of maps over gaps and past borders: the least bent sheet through what is known."""

import cv2
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

Float = NDArray[np.floating]
Bool = NDArray[np.bool_]

STIFF = 1e-3  # weight of a little tension beside the bending, in grid steps: far from all data a sheet turns level


def fill(values: Float, known: Bool, wanted: Bool, nodes: int = 20000) -> Float:
    """`values` (H, W, C), continued from `known` to `wanted` (H, W).

    On a grid of about `nodes` points over the box of both, the unknown ones minimise the sum of squared Laplacians (a thin
    plate); between them the continuation is bilinear. Known values are returned as they are; NaN where neither holds.

    Raises
    ------
    ValueError
        if nothing is known.
    """
    if not known.any():
        raise ValueError("nothing is known to continue from")
    out = np.where(known[..., None], values, np.nan).astype(np.float32)
    todo = wanted & ~known
    if not todo.any():
        return out
    y, x = np.nonzero(wanted | known)
    box = slice(y.min(), y.max() + 1), slice(x.min(), x.max() + 1)
    step = max(2, int(np.ceil(np.sqrt(out[box].shape[0] * out[box].shape[1] / nodes))))
    grid, sure = _means(values[box], known[box], step)
    sheet = _plate(grid, sure)
    yy, xx = np.nonzero(todo[box])
    down, across = ((k + 0.5) / step - 0.5 for k in (yy, xx))  # half a cell past the last one it goes straight on
    i, j = (np.clip(np.floor(k).astype(int), 0, max(n - 2, 0)) for k, n in zip((down, across), sheet.shape[:2], strict=True))
    fy, fx = (down - i)[:, None], (across - j)[:, None]
    i1, j1 = np.minimum(i + 1, sheet.shape[0] - 1), np.minimum(j + 1, sheet.shape[1] - 1)
    top = sheet[i, j] * (1 - fx) + sheet[i, j1] * fx
    out[box][yy, xx] = top * (1 - fy) + (sheet[i1, j] * (1 - fx) + sheet[i1, j1] * fx) * fy
    return out


def _means(values: Float, known: Bool, step: int) -> tuple[Float, Bool]:
    """Values (h, w, C) of the cells of `step` px that are known all over, and which they are."""
    h, w = (-(-n // step) for n in known.shape)
    padded = np.zeros((h * step, w * step), np.float32)
    padded[: known.shape[0], : known.shape[1]] = known
    inside = np.zeros_like(padded)
    inside[: known.shape[0], : known.shape[1]] = 1
    share = cv2.resize(padded, (w, h), interpolation=cv2.INTER_AREA)
    whole = cv2.resize(inside, (w, h), interpolation=cv2.INTER_AREA)
    sure = (share > 0) & (share >= whole - 1e-4) & (whole > 1 - 1e-4)
    if not sure.any():
        sure = share >= share.max() - 1e-4
    out = np.zeros((h, w, values.shape[2]))
    for k in range(values.shape[2]):
        channel = np.zeros_like(padded)
        channel[: known.shape[0], : known.shape[1]] = np.where(known, values[..., k], 0)
        out[..., k] = cv2.resize(channel, (w, h), interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    return out, sure


def _plate(grid: Float, sure: Bool) -> Float:
    """`grid` (h, w, C) with the cells that are not `sure` put where they bend the sheet least."""
    h, w = sure.shape
    size = h * w

    def second(n: int) -> sp.csr_matrix:
        return sp.diags([np.ones(n - 2), np.full(n - 2, -2.0), np.ones(n - 2)], [0, 1, 2], shape=(n - 2, n))

    def first(n: int) -> sp.csr_matrix:
        return sp.diags([-np.ones(n - 1), np.ones(n - 1)], [0, 1], shape=(n - 1, n))

    rows = []
    one = [sp.identity(h), sp.identity(w)]
    if h > 2:
        rows.append(sp.kron(second(h), one[1]))
    if w > 2:
        rows.append(sp.kron(one[0], second(w)))
    if h > 1 and w > 1:
        rows.append(np.sqrt(2) * sp.kron(first(h), first(w)))
    if h > 1:
        rows.append(STIFF * sp.kron(first(h), one[1]))
    if w > 1:
        rows.append(STIFF * sp.kron(one[0], first(w)))
    out = grid.reshape(size, -1).copy()
    if not rows:
        return out.reshape(grid.shape)
    bend = sp.vstack(rows).tocsr()
    free = ~sure.ravel()
    touched = np.asarray(abs(bend[:, free]).sum(1) > 0).ravel()
    a = bend[touched]
    inner = a[:, free]
    right = -(a[:, ~free] @ out[~free])
    out[free] = np.asarray(spsolve((inner.T @ inner).tocsc(), inner.T @ right)).reshape(int(free.sum()), -1)
    return out.reshape(grid.shape)
