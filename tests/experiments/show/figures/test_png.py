"""Pictures are read back by another program as they were."""

import io

import numpy as np
import pytest
from PIL import Image

from experiments.show.figures.png import png_bytes


@pytest.mark.parametrize("shape", [(1, 1), (3, 500), (301, 7)])
def test_pixels_and_resolution_come_back(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    with_alpha = rng.integers(0, 256, (*shape, 4), dtype=np.uint8)
    with Image.open(io.BytesIO(png_bytes(with_alpha[..., :3], 200))) as picture:
        picture.verify()  # each chunk's checksum
    with Image.open(io.BytesIO(png_bytes(with_alpha[..., :3], 200))) as picture:
        assert picture.mode == "RGB"
        assert picture.info["dpi"] == pytest.approx((200, 200), abs=0.01)
        np.testing.assert_array_equal(np.asarray(picture), with_alpha[..., :3])
