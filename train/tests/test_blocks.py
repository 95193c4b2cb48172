"""Rotary positions and masked attention."""

import torch

from streetforward import config as cfg
from streetforward.blocks import Attention, Rope, patch_positions


def turned(vector, position, config):
    rope = Rope(torch.tensor([position]), len(vector), config)
    return rope(vector[None])[0]


def test_rope_sees_position_differences_only():
    torch.manual_seed(1)
    q, k = torch.randn(2, 24, dtype=torch.float64)
    config = cfg.nano()
    for a, b in [((1, 1), (3, 2)), ((4, 9), (2, 11))]:
        moved = [tuple(x + s for x, s in zip(p, (5, 7))) for p in (a, b)]
        here = turned(q, a, config) @ turned(k, b, config)
        there = turned(q, moved[0], config) @ turned(k, moved[1], config)
        assert abs(here - there) < 1e-12
    # Swapping rows and columns is another rotation.
    assert abs(turned(q, (1, 4), config) @ k - turned(q, (4, 1), config) @ k) > 1e-3


def test_rope_leaves_registers_alone_and_turns_by_the_formula():
    config = cfg.nano()
    x = torch.arange(1.0, 9.0, dtype=torch.float64)
    assert torch.equal(turned(x, (0, 0), config), x)
    # Head width 8: halves of 4, channel m pairs with m + 2, theta_m = position * 100^(-m/2).
    theta = torch.tensor([3.0, 0.3], dtype=torch.float64)
    expected = torch.cat((x[0:2] * theta.cos() - x[2:4] * theta.sin(), x[2:4] * theta.cos() + x[0:2] * theta.sin()))
    assert torch.allclose(turned(x, (3, 5), config)[:4], expected, atol=1e-14)


def test_rope_rounds_angles_to_bf16_when_asked():
    config = cfg.nano() | {"rope.angle_round": "bf16", "rope.base": 7.0}
    rope = Rope(torch.tensor([[3, 5]]), 8, config)
    angle = torch.tensor(3 * 7.0**-0.5, dtype=torch.float64)
    rounded = angle.to(torch.bfloat16).to(torch.float64)
    assert rounded != angle
    assert rope.cos[0, 0, 1] == rounded.cos()


def test_positions_count_from_one_and_registers_stand_at_the_origin():
    assert patch_positions(2, 3, 1).tolist() == [[0, 0], [1, 1], [1, 2], [1, 3], [2, 1], [2, 2], [2, 3]]


def test_a_query_without_keys_gets_the_bias_of_the_projection():
    torch.manual_seed(2)
    attention = Attention(8, 2, qk_eps=1e-5)
    mask = torch.tensor([[False, False, False], [True, False, True], [True, True, True]])
    y = attention(torch.randn(1, 3, 8), mask=mask)
    assert torch.equal(y[0, 0], attention.proj.bias)
    assert y.isfinite().all()
    assert not torch.equal(y[0, 1], attention.proj.bias)


def test_attention_is_the_written_formula():
    torch.manual_seed(3)
    attention = Attention(8, 2, qk_eps=1e-5).double()
    x = torch.randn(1, 5, 8, dtype=torch.float64)
    q, k, v = attention.qkv(x[0]).split(8, dim=-1)
    heads = []
    for h in range(2):
        columns = slice(4 * h, 4 * h + 4)
        qh, kh = attention.q_norm(q[:, columns]), attention.k_norm(k[:, columns])
        heads.append((qh @ kh.T / 2).softmax(dim=-1) @ v[:, columns])
    assert torch.allclose(attention(x)[0], attention.proj(torch.cat(heads, dim=-1)), atol=1e-12)
