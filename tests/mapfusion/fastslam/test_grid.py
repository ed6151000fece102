import numpy as np
import pytest

from mapfusion.fastslam.grid import Grid


def touching(box, boxes, held):
    low = np.all(boxes[:, :2] <= box[2:], axis=1)
    high = np.all(boxes[:, 2:] >= box[:2], axis=1)
    return np.flatnonzero(low & high & held)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_finds_what_looking_at_all_finds(scale):
    rng = np.random.default_rng(0)
    capacity = 64
    grid, boxes, held = Grid(capacity), np.zeros((256, 4)), np.zeros(256, dtype=bool)
    for round_ in range(60):
        if round_ == 30:
            capacity = 256
            grid.grow(capacity, boxes)
        names = rng.choice(capacity, rng.integers(0, 20), replace=False)
        corner = rng.uniform(-20, 20, (len(names), 2))
        side = 10.0 ** rng.uniform(-3, 1.3, (len(names), 2))
        boxes[names] = scale * np.concatenate([corner, corner + side], axis=1)
        grid.place(names, boxes)
        held[names] = True
        gone = rng.choice(capacity, 5)
        grid.remove(gone)
        held[gone] = False
        for _ in range(4):
            low = rng.uniform(-25, 25, 2)
            box = scale * np.concatenate([low, low + 10.0 ** rng.uniform(-3, 1.5, 2)])
            assert grid.near(box, boxes).tolist() == touching(box, boxes, held).tolist()


def test_an_empty_grid_finds_nothing():
    assert len(Grid(4).near(np.array([-1.0, -1, 1, 1]), np.zeros((4, 4)))) == 0


def test_points_are_boxes_too():
    boxes = np.array([[1.0, 2.0, 1.0, 2.0], [5.0, 5.0, 5.0, 5.0]])
    grid = Grid(2)
    grid.place(np.array([0, 1]), boxes)
    assert grid.near(np.array([1.0, 2.0, 1.0, 2.0]), boxes).tolist() == [0]
