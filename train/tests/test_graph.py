"""The fixed-size graph that exporters take has the model's outputs."""

import pytest
import torch

from streetforward.golden import CASES
from streetforward.graph import Graph, constants, finish, inputs, sight
from streetforward.weights import golden_model

FIXED = [case for case in CASES if case.config()["motion.layout"] == "per_direction"]


@pytest.mark.parametrize("case", FIXED, ids=lambda case: case.name)
def test_outputs_are_the_models(case):
    config = case.config()
    model = golden_model(config, case.seed)
    images, times = torch.from_numpy(case.images()), torch.from_numpy(case.times())
    with torch.no_grad(), constants():
        want = model(images, times)
        graph = Graph(model, *images.shape[:3])
        raw = graph(*inputs(config, images, times))
        have = finish(dict(zip(graph.names, raw, strict=True)), images, times, config)
    missing = {"colour", "opacity", "scale", "quat"} if config["gs.kind"] == "none" else set()
    missing |= set() if graph.moving else {"v_fwd", "v_bwd", "dynamic"}
    assert set(want) - set(have) == missing
    for name, tensor in have.items():
        scale = want[name].abs().max().item()
        assert (tensor - want[name]).abs().max().item() <= 2e-4 * scale, name


def test_frames_in_sight_are_grouped():
    assert sight(4, 0, 1) == [[0, 3, [0, 1]], [3, 4, [0]]]
    assert sight(3, -1, -1) == [[0, 1, []], [1, 3, [-1]]]
    assert sum(end - first for first, end, _ in sight(7, -2, 2)) == 7


def test_single_pass_is_refused():
    case = next(case for case in CASES if case.config()["motion.layout"] == "single_pass")
    with pytest.raises(ValueError, match="single_pass"):
        Graph(golden_model(case.config(), case.seed), *case.images().shape[:3])
