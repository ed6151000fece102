"""Where landmarks may be matched: boxes around their means and gates, and a search among them."""

import math

import numpy as np

from mapfusion.fastslam.slots import BLOCK, COMMON, Slots
from mapfusion.kernels import inner_kernel, kernel, kernel_part
from mapfusion.se2 import Float


@kernel
def bound(slots: Slots, which: np.ndarray, gate: float) -> None:
    """Write the boxes of slots that are up to date, and of their blocks."""
    own, common, boxes = slots.own, slots.common, slots.box_m
    for s in which:
        low_x = low_y = math.inf
        high_x = high_y = -math.inf
        spread_x = spread_y = 0.0
        if slots.generation[s] == COMMON:
            low_x = high_x = common.mean_m[s, 0, 0]
            low_y = high_y = common.mean_m[s, 0, 1]
            spread_x, spread_y = common.covariance_m2[s, 0, 0], common.covariance_m2[s, 0, 3]
        else:
            r = slots.row[s]
            for m in range(own.count.shape[1]):
                if own.count[r, m] == 0:
                    continue
                x, y = own.mean_m[r, m, 0], own.mean_m[r, m, 1]
                low_x, low_y = min(low_x, x), min(low_y, y)
                high_x, high_y = max(high_x, x), max(high_y, y)
                spread_x = max(spread_x, own.covariance_m2[r, m, 0])
                spread_y = max(spread_y, own.covariance_m2[r, m, 3])
        # Inside the gate |dx| <= sqrt(gate (Sigma_xx + R_xx)), at most the sum of both roots: one
        # is the landmark's margin, the other the observation's.
        margin_x, margin_y = math.sqrt(gate * spread_x), math.sqrt(gate * spread_y)
        boxes[s, 0], boxes[s, 1] = low_x - margin_x, low_y - margin_y
        boxes[s, 2], boxes[s, 3] = high_x + margin_x, high_y + margin_y
    last = -1
    for s in which:
        if s // BLOCK != last:
            last = s // BLOCK
            _bound_block(slots, last)


def bend_boxes(slots: Slots, which: np.ndarray, T_map_bent: Float) -> None:
    """Put boxes around what is in those of slots (n,) after each slot's motion (S, 3)."""
    shift_x, shift_y, turn = T_map_bent[which].T
    cos, sin = np.cos(turn), np.sin(turn)
    low_x, low_y, high_x, high_y = slots.box_m[which].T
    x, y = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y)
    half_x, half_y = 0.5 * (high_x - low_x), 0.5 * (high_y - low_y)
    wide_x = np.abs(cos) * half_x + np.abs(sin) * half_y
    wide_y = np.abs(sin) * half_x + np.abs(cos) * half_y
    x, y = cos * x - sin * y + shift_x, sin * x + cos * y + shift_y
    slots.box_m[which] = np.stack([x - wide_x, y - wide_y, x + wide_x, y + wide_y], axis=1)
    blocks = slots.box_m.reshape(-1, BLOCK, 4)
    slots.block_box_m[:, :2] = blocks[:, :, :2].min(axis=1)
    slots.block_box_m[:, 2:] = blocks[:, :, 2:].max(axis=1)


@kernel_part
def _bound_block(slots: Slots, block: int) -> None:
    """Write the box of a block around those of its slots."""
    boxes, around = slots.box_m, slots.block_box_m
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    for s in range(block * BLOCK, (block + 1) * BLOCK):
        low_x, low_y = min(low_x, boxes[s, 0]), min(low_y, boxes[s, 1])
        high_x, high_y = max(high_x, boxes[s, 2]), max(high_y, boxes[s, 3])
    around[block, 0], around[block, 1] = low_x, low_y
    around[block, 2], around[block, 3] = high_x, high_y


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
