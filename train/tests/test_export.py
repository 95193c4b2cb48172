"""Golden tensors and checkpoints on disk."""

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from streetforward import StreetForward, config as cfg
from streetforward.export import deviation, golden_case, main, run_stages
from streetforward.golden import CASES
from streetforward.weights import golden_model

GOLDEN = Path(__file__).parents[2] / "tests" / "data" / "golden"


def read_config(path):
    with safe_open(path, "pt") as file:
        return cfg.from_json(file.metadata()[cfg.METADATA_KEY])


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_committed_golden_tensors_are_this_models(case):
    path = GOLDEN / f"{case.name}.safetensors"
    committed, (tensors, _, _) = load_file(path), golden_case(case)
    assert read_config(path) == case.config()
    assert set(committed) == set(tensors)
    for name, tensor in tensors.items():
        if name.startswith(("w.", "in.")):
            assert torch.equal(committed[name], tensor), name
        else:
            assert torch.allclose(committed[name], tensor, rtol=1e-6, atol=1e-6 * tensor.abs().max().item()), name


# What each case is there for: the setting and the value that a mistaken engine would use in its place.
DISCRIMINATES = [
    ("linear", "conf.eps", 1e-6),
    ("linear", "aa.qk_eps", 1e-2),
    ("dpt", "gs.eps", 1e-5),
    ("dpt", "motion.scale", 1.0),
    ("dpt", "motion.bias", 0.0),
    ("dpt", "gs.rcu_skip", "raw"),
    ("dpt", "gs.taps", [0, 1, 3, 2]),
    ("dpt", "motion.taps", [0, 1, 3, 2]),
    ("depth_dpt", "depth.rcu_skip", "relu"),
    ("depth_dpt", "camera.pixel", "half"),
    ("strict_mask", "mask.self", True),
    ("strict_mask", "mask.k", 1),
    ("strict_mask", "world.scale", 1.0),
    ("figure", "mask.orientation", "equation"),
    ("figure", "motion.back_sign", 1),
    ("figure", "render.extrapolate", "mirror"),
    ("figure", "encoder.eps", 1e-6),
    ("figure", "aa.eps", 1e-6),
    ("figure", "motion.eps", 1e-6),
    ("single_pass", "motion.bias", 0.0),
    ("single_pass", "mask.k", 2),
    ("order", "aa.order", "frame_first"),
    ("order", "causal.registers", False),
    ("order", "time.base", 10000.0),
    ("order", "time.unit", 0.1),
    ("order", "image.mean", [0.485, 0.456, 0.406]),
    ("order", "image.std", [0.229, 0.224, 0.225]),
    ("two_sets", "camera.k", "fit_shared"),
    ("two_sets", "motion.frame", "camera"),
    ("two_sets", "motion.per", "second"),
    ("two_sets", "motion.combine", "mean"),
    ("two_sets", "mask.k", 1),
    ("two_sets", "motion.rcu_skip", "relu"),
    ("guided", "motion.back_sign", 1),
    ("guided", "motion.scale", 1.0),
    ("guided", "motion.bias", 0.0),
    ("guided", "motion.eps", 1e-6),
    ("dggt", "gs.out_map", "residual"),
    ("dggt", "rope.angle_round", "none"),
    ("dggt", "rope.base", 100.0),
    ("dggt", "world.anchor", "first"),
    ("dggt", "depth.eps", 1e-5),
    ("dggt", "aa.qk_eps", 1e-5),
]


@pytest.mark.parametrize(("name", "key", "other"), DISCRIMINATES)
def test_a_wrong_setting_shows(case, name, key, other):
    """The same weights under another convention leave the tolerance of 1e-4 far behind in some stage."""
    chosen = case[name]
    assert chosen.config()[key] != other
    model = golden_model(chosen.config(), chosen.seed)
    right = run_stages(model, chosen)
    model.config = chosen.config() | {key: other}
    if key.endswith((".eps", ".qk_eps", ".rcu_skip")):  # settings that live in the modules
        model = StreetForward(model.config)
        model.load_state_dict(golden_model(chosen.config(), chosen.seed).state_dict())
    wrong = run_stages(model, chosen)
    assert max(deviation(wrong[stage], right[stage]) for stage in right) > 5e-4


def test_a_checkpoint_is_reproducible_and_describes_itself(tmp_path):
    a, b = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    for path in (a, b):
        main(["checkpoint", "--preset", "nano", "--linear-heads", "--seed", "7", "-o", str(path)])
    assert a.read_bytes() == b.read_bytes()
    model = StreetForward(read_config(a))
    model.load_state_dict(load_file(a), strict=True)
    assert sum(p.numel() for p in model.parameters()) == 4_262_546
    assert (model.motion_head.proj.weight == 0).all()
    images = torch.zeros(2, 28, 42, 3, dtype=torch.uint8)
    with torch.no_grad():
        outputs = model(images, torch.tensor([0.0, 0.1], dtype=torch.float64))
    assert all(tensor.isfinite().all() for tensor in outputs.values())
    assert (outputs["v_fwd"] == 0).all()


def test_sizes_that_do_not_divide_into_patches_are_refused():
    model = StreetForward(CASES[0].config())
    with pytest.raises(ValueError, match="multiples of 14"):
        model(torch.zeros(1, 30, 42, 3, dtype=torch.uint8), torch.zeros(1))
    with pytest.raises(ValueError, match="2 times for 1 frames"):
        model(torch.zeros(1, 28, 42, 3, dtype=torch.uint8), torch.zeros(2))
