"""Where landmarks may be matched: boxes around their means and gates, and a search among them."""

import numpy as np

from mapfusion.fastslam.slots import BLOCK, COMMON, Slots
from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.se2 import Float


@kernel
def bound(slots: Slots, which: np.ndarray, gate: float) -> None:
    """Write the boxes of slots that are up to date, and of their blocks."""
    for s in which:
        box, spread_x, spread_y = slots.box_m[s], 0.0, 0.0
        if slots.generation[s] == COMMON:
            box[0] = box[2] = slots.common.mean_m[s, 0, 0]
            box[1] = box[3] = slots.common.mean_m[s, 0, 1]
            spread_x = slots.common.covariance_m2[s, 0, 0]
            spread_y = slots.common.covariance_m2[s, 0, 3]
        else:
            box[:2], box[2:] = np.inf, -np.inf
            r = slots.row[s]
            for m in range(slots.own.count.shape[1]):
                if slots.own.count[r, m] == 0:
                    continue
                x, y = slots.own.mean_m[r, m, 0], slots.own.mean_m[r, m, 1]
                box[0], box[1] = min(box[0], x), min(box[1], y)
                box[2], box[3] = max(box[2], x), max(box[3], y)
                spread_x = max(spread_x, slots.own.covariance_m2[r, m, 0])
                spread_y = max(spread_y, slots.own.covariance_m2[r, m, 3])
        # Inside the gate |dx| <= sqrt(gate (Sigma_xx + R_xx)), at most the sum of both roots: one
        # is the landmark's margin, the other the observation's.
        margin_x, margin_y = np.sqrt(gate * spread_x), np.sqrt(gate * spread_y)
        box[0], box[1] = box[0] - margin_x, box[1] - margin_y
        box[2], box[3] = box[2] + margin_x, box[3] + margin_y
    last = -1
    for s in which:
        if s // BLOCK != last:
            last = s // BLOCK
            bound_block(slots, last)


@kernel_part
def bend_box(slots: Slots, s: int, motion: Float) -> None:
    """Put a box around what is in it after a motion (3,) of the plane."""
    box = slots.box_m[s]
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    half_x, half_y = 0.5 * (box[2] - box[0]), 0.5 * (box[3] - box[1])
    wide_x = abs(cos) * half_x + abs(sin) * half_y
    wide_y = abs(sin) * half_x + abs(cos) * half_y
    x, y = cos * x - sin * y + motion[0], sin * x + cos * y + motion[1]
    box[0], box[1], box[2], box[3] = x - wide_x, y - wide_y, x + wide_x, y + wide_y


@kernel
def bound_block(slots: Slots, block: int) -> None:
    """Write the box of a block around those of its slots."""
    around = slots.block_box_m[block]
    around[:2], around[2:] = np.inf, -np.inf
    for s in range(block * BLOCK, (block + 1) * BLOCK):
        around[0] = min(around[0], slots.box_m[s, 0])
        around[1] = min(around[1], slots.box_m[s, 1])
        around[2] = max(around[2], slots.box_m[s, 2])
        around[3] = max(around[3], slots.box_m[s, 3])


@inner_kernel
def touches(boxes: Float, i: int, box: Float) -> bool:
    """Whether row i of boxes (N, 4) and a box (4,) have a point in common."""
    x = (boxes[i, 0] <= box[2]) & (boxes[i, 2] >= box[0])
    y = (boxes[i, 1] <= box[3]) & (boxes[i, 3] >= box[1])
    return x & y


@kernel
def near(slots: Slots, box: Float) -> np.ndarray:
    """Slots, ascending, whose boxes touch a box (4,)."""
    blocks = np.empty(len(slots.block_box_m), np.int64)
    n_blocks = n = 0
    for block in range(len(blocks)):
        if touches(slots.block_box_m, block, box):
            blocks[n_blocks] = block
            n_blocks += 1
    found = np.empty(n_blocks * BLOCK, np.int64)
    for block in blocks[:n_blocks]:
        for s in range(block * BLOCK, (block + 1) * BLOCK):
            if touches(slots.box_m, s, box):
                found[n] = s
                n += 1
    return found[:n]
