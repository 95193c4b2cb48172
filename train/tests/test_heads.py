"""Dense heads and the camera's rotation."""

import pytest
import torch

from streetforward import config as cfg
from streetforward.heads import DptHead, GuidedHead, PixelShuffleHead, ResidualUnit, nearest_rotation, uv_embedding


def test_pixel_shuffle_of_a_ramp_gives_the_pixel_coordinates():
    patch, channels = 3, 2
    head = PixelShuffleHead(4, channels, patch)
    with torch.no_grad():
        head.proj.weight.zero_()
        head.proj.bias.copy_(torch.arange(channels * patch * patch))
        image = head(torch.randn(1, 2 * 5, 4), (2, 5))
    assert image.shape == (1, 6, 15, 2)
    for c in range(channels):
        for y in range(6):
            for x in range(15):
                assert image[0, y, x, c] == c * 9 + (y % patch) * patch + x % patch


def test_pixel_shuffle_puts_each_patch_in_its_place():
    head = PixelShuffleHead(1, 1, 2)
    with torch.no_grad():
        head.proj.weight.fill_(1)
        head.proj.bias.zero_()
        image = head(torch.arange(6.0)[None, :, None], (2, 3))
    assert image[0, ::2, ::2, 0].tolist() == [[0, 1, 2], [3, 4, 5]]


def test_rotations_are_proper_and_nearest():
    torch.manual_seed(1)
    nine = torch.randn(200, 9)
    rotation = nearest_rotation(nine)
    eye = torch.eye(3, dtype=torch.float64)
    assert (torch.linalg.det(nine.unflatten(-1, (3, 3))) < 0).sum() > 50
    assert torch.allclose(rotation @ rotation.transpose(1, 2), eye.expand(200, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(200, dtype=torch.float64))
    m = torch.nn.functional.normalize(nine.double().unflatten(-1, (3, 3)), dim=-1)
    distance = (rotation - m).square().sum((1, 2))
    for _ in range(50):
        near = torch.linalg.matrix_exp((lambda a: a - a.transpose(1, 2))(0.1 * torch.randn(200, 3, 3).double()))
        assert ((near @ rotation - m).square().sum((1, 2)) >= distance - 1e-12).all()


def test_a_rotation_is_its_own_projection():
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.5], [0.3, 0.0, -0.9], [-0.5, 0.9, 0.0]]).double())
    assert torch.allclose(nearest_rotation(turn.flatten()), turn, atol=1e-12)
    assert torch.allclose(nearest_rotation(2.5 * turn.flatten()), turn, atol=1e-12)


def test_uv_embedding_by_hand():
    aspect = 28 / 14
    embedding = uv_embedding(8, (1, 2), aspect)
    assert embedding.shape == (8, 1, 2)
    u = aspect / (1 + aspect**2) ** 0.5 * 0.5  # right column: span (n - 1) / n with n = 2
    expected = [u, u * 0.1, u, u * 0.1, 0, 0, 0, 0]  # frequencies 1 and 100^(-1/2)
    sines = [f(torch.tensor(x, dtype=torch.float64)) for f, x in zip([torch.sin] * 2 + [torch.cos] * 2, expected)]
    assert torch.allclose(embedding[:4, 0, 1], torch.stack(sines), atol=1e-14)
    assert embedding[4:, 0, 0].tolist() == [0, 0, 1, 1]
    assert torch.allclose(embedding[:2, 0, 0], -embedding[:2, 0, 1])


@pytest.mark.parametrize("skip", ["relu", "raw"])
def test_the_skip_of_a_residual_unit(skip):
    unit = ResidualUnit(2, skip)
    with torch.no_grad():
        unit.conv2.weight.zero_()
        unit.conv2.bias.zero_()
        x = torch.randn(1, 2, 3, 3)
        assert torch.equal(unit(x), x.relu() if skip == "relu" else x)


@pytest.mark.parametrize("grid", [(1, 1), (2, 3), (3, 5)])
def test_dpt_fills_the_image_at_every_grid(grid):
    config = cfg.nano() | cfg.dpt_head("gs", 11, [0, 0, 0, 0], [4, 8, 4, 8], 8, hidden=4)
    head = DptHead(6, "gs", config)
    taps = [torch.randn(2, grid[0] * grid[1], 6) for _ in range(4)]
    with torch.no_grad():
        out = head(taps, grid, patch=7)
    assert out.shape == (2, 7 * grid[0], 7 * grid[1], 11)
    assert out.isfinite().all()


def guided(**changes):
    config = cfg.nano() | {"patch": 6, "guide.channels": 3}
    return GuidedHead("x", config | cfg.guided_head("x", 2, 8, 1, 1, hidden=5, features=7) | changes)


def test_guided_head_by_the_written_indices():
    """Both shuffles, the order of the joined channels and the skip, element by element in f64."""
    torch.manual_seed(2)
    rows, columns, half = 2, 3, 3
    head = guided().double()
    tokens = torch.randn(1, rows * columns, 8, dtype=torch.float64)
    guide = torch.randn(1, 3, rows * half, columns * half, dtype=torch.float64)
    with torch.no_grad():
        image = head(tokens, (rows, columns), guide)
        flat = head.proj(tokens)[0]
        x = torch.zeros(1, 8, rows * half, columns * half, dtype=torch.float64)
        for y in range(rows * half):
            for z in range(columns * half):
                token = flat[(y // half) * columns + z // half]
                for c in range(5):
                    x[0, c, y, z] = token[c * half * half + (y % half) * half + z % half]
        x[:, 5:] = guide
        conv = [lambda t, m=m: torch.conv2d(t, m.weight, m.bias, padding=1) for m in head.conv]
        x = conv[0](x).relu()
        y = (x + conv[2](conv[1](x).relu())).relu()
        out = conv[3](y)[0]
    assert image.shape == (1, 12, 18, 2)
    for v in range(12):
        for u in range(18):
            for c in range(2):
                expected = out[c * 4 + (v % 2) * 2 + u % 2, v // 2, u // 2].item()
                assert image[0, v, u, c].item() == pytest.approx(expected, abs=1e-12)


def test_guided_heads_need_an_even_patch_and_a_guide():
    with pytest.raises(ValueError, match="even patch"):
        GuidedHead("depth", cfg.nano() | {"patch": 7})
    with pytest.raises(ValueError, match="guide.channels"):
        GuidedHead("depth", cfg.nano() | {"guide.channels": 0})
