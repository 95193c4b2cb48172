"""The position table and its resize."""

import numpy as np
import pytest
import torch
from PIL import Image

from streetforward.encoder import resize_matrix, resize_positions


@pytest.mark.parametrize(("n", "m"), [(37, 20), (37, 12), (37, 44), (5, 9), (16, 18), (4, 1)])
def test_weights_sum_to_one_and_agree_with_pillow(n, m):
    weights = resize_matrix(n, m)
    assert torch.allclose(weights.sum(dim=1), torch.ones(m, dtype=torch.float64), atol=1e-14)
    line = np.random.default_rng(1).standard_normal((1, n)).astype(np.float32)
    resized = np.asarray(Image.fromarray(line, mode="F").resize((m, 1), Image.Resampling.BICUBIC))
    assert np.abs(weights.numpy() @ line[0] - resized[0]).max() < 2e-6


def test_own_size_is_bit_exact_and_by_the_formula_the_identity():
    torch.manual_seed(1)
    table = torch.randn(1 + 37 * 37, 3)
    assert torch.equal(resize_positions(table, 37, 37), table)
    assert torch.equal(resize_matrix(37, 37), torch.eye(37, dtype=torch.float64))


def test_rows_and_columns_are_not_mixed_up():
    row = torch.arange(5.0)[:, None].expand(5, 5)
    table = torch.cat((torch.full((1, 1), 9.0), row.reshape(25, 1)))
    resized = resize_positions(table, 3, 5)
    assert resized[0, 0] == 9
    grid = resized[1:, 0].unflatten(0, (3, 5))
    assert torch.allclose(grid, grid[:, :1].expand(3, 5))
    assert (grid[1:] > grid[:-1]).all()
