"""Time: the embedding, who sees whom, and what must not leak."""

import pytest
import torch

from streetforward import config as cfg
from streetforward.causal import frame_mask, pass_ranges, run_pass, time_embedding
from streetforward.weights import golden_model


def test_time_embedding_by_hand():
    config = cfg.nano() | {"time.d_t": 4, "time.base": 100.0, "time.unit": 0.1}
    tau = time_embedding(torch.tensor([5.0, 5.25], dtype=torch.float64), config)
    assert tau[0].tolist() == [0, 0, 1, 1]
    angle = torch.tensor([2.5, 0.25], dtype=torch.float64)
    assert torch.allclose(tau[1], torch.cat((angle.sin(), angle.cos())), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "forward", "backward"),
    [
        ({}, (0, 1), (-1, 0)),
        ({"mask.k": 3}, (0, 3), (-3, 0)),
        ({"mask.self": False, "mask.k": 2}, (1, 2), (-2, -1)),
        ({"mask.orientation": "figure"}, (-1, 0), (0, 1)),
    ],
)
def test_ranges(changes, forward, backward):
    assert pass_ranges(cfg.nano() | changes) == {"fwd": forward, "bwd": backward}


def test_a_single_pass_sees_both_ways():
    assert pass_ranges(cfg.nano() | {"motion.layout": "single_pass"}) == {"fwd": (-1, 1)}


def test_masks():
    assert frame_mask(3, 0, 1).int().tolist() == [[1, 1, 0], [0, 1, 1], [0, 0, 1]]
    assert frame_mask(3, -2, -1).int().tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]


@pytest.fixture
def passes(case):
    """Runs the forward pass of a four-frame network on given tokens."""
    chosen = case["dpt"]
    model = golden_model(chosen.config(), chosen.seed).double()
    tokens = torch.randn(4, 15, cfg.causal_dim(chosen.config()), dtype=torch.float64)

    def run(tokens):
        with torch.no_grad():
            return run_pass(model.causal, tokens, (0, 1), (3, 5), chosen.config())

    return run, tokens


def changed(run, tokens, frame):
    """Which frames' features change after every layer when one frame's tokens do: [layers][frames]."""
    other = tokens.clone()
    other[frame] += 1
    pairs = zip(run(tokens), run(other))
    return [[not torch.equal(a[f], b[f]) for f in range(len(tokens))] for a, b in pairs]


def test_the_future_arrives_one_layer_per_frame(passes):
    layers = changed(*passes, frame=2)
    assert layers[0] == [False, True, True, False]
    assert layers[1] == [True, True, True, False]


def test_the_past_never_arrives(passes):
    for layer in changed(*passes, frame=0):
        assert layer == [True, False, False, False]


def test_the_last_frame_of_a_strict_mask_keeps_running(case, run):
    stages = run(case["strict_mask"])
    assert all(stage.isfinite().all() for stage in stages.values())
    # The last frame of the forward pass and the first one of the backward pass see nobody: they mirror the other pass.
    assert torch.equal(stages["out.v_fwd"][-1], -stages["out.v_bwd"][-1])
    assert torch.equal(stages["out.v_bwd"][0], -stages["out.v_fwd"][0])


def test_the_figures_orientation_swaps_the_passes(case, run):
    equation, figure = run(case["figure"], mask__orientation="equation"), run(case["figure"])
    assert torch.allclose(equation["motion.fwd"], figure["motion.bwd"])
    assert torch.allclose(equation["motion.bwd"], figure["motion.fwd"])
    assert not torch.allclose(figure["motion.bwd"], figure["motion.fwd"], atol=1e-3)
