"""The batched forward against the readable one."""

import pytest
import torch

from streetforward import config as cfg
from streetforward.batched import Wanted, forward_clips, rotations
from streetforward.golden import CASES
from streetforward.heads import nearest_rotation
from streetforward.weights import golden_model


@pytest.mark.parametrize("name", ["guided", "linear", "dpt", "depth_dpt", "figure", "two_sets", "pi3"])
def test_two_clips_at_once_are_each_clip_alone(name):
    """Two clips that differ in pictures and times, in f64; heads on some frames in another order."""
    case = next(c for c in CASES if c.name == name)
    model = golden_model(case.config(), case.seed).double()
    config, frames = model.config, case.frames
    images = torch.from_numpy(case.images())
    images = torch.stack((images, images.flip(0)))
    times = torch.from_numpy(case.times())
    times = torch.stack((times, 2 * times))
    rows = torch.tensor([frames, 1, 2 * frames - 1])
    wanted = Wanted(depth=rows)
    if config["gs.kind"] != "none":
        wanted.gs = rows
    if cfg.has_motion(config):
        wanted.motion = {"fwd": rows, "bwd": rows.flip(0)}
    with torch.no_grad():
        raw = forward_clips(model, images.double() / 255, times, wanted)
        stages = [{}, {}]
        for b in range(2):
            model(images[b], times[b], stages[b])

    def expected(name, rows=rows):
        return torch.cat([s[name] for s in stages])[rows]

    def close(a, b):
        assert a.shape == b.shape
        assert torch.allclose(a.double(), b, rtol=1e-9, atol=1e-9), (a - b).abs().max()

    close(raw.log_depth(config).exp(), expected("point")[..., -1])
    close(raw.rotation.flatten(0, 1), torch.cat([s["pose"] for s in stages])[:, :3, :3])
    close(raw.translation.flatten(0, 1).double(), torch.cat([s["camera.t"] for s in stages]))
    if wanted.gs is not None:
        close(raw.gs, expected("gs.raw"))
    if "conf" in stages[0]:
        close(raw.solid(config), expected("conf"))
    for way in raw.motion:
        close(raw.motion[way], expected(f"motion.{way}", wanted.motion[way]))
    if wanted.motion:
        assert set(raw.motion) == {"fwd", "bwd"}


def test_rotation_gradient():
    """Against difference quotients, reflections included; finite at the identity, where singular values meet."""
    torch.manual_seed(3)
    nine = torch.randn(8, 9, dtype=torch.float64, requires_grad=True)
    assert (torch.linalg.det(nine.unflatten(-1, (3, 3))) < 0).any()
    assert torch.autograd.gradcheck(rotations, nine)
    assert torch.allclose(rotations(nine), nearest_rotation(nine), atol=1e-14)
    eye = torch.eye(3, dtype=torch.float64).flatten().requires_grad_()
    rotations(eye)[0, 1].backward()
    assert eye.grad.tolist() == pytest.approx([0, 0.5, 0, -0.5, 0, 0, 0, 0, 0])
