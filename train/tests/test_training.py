"""Training: data, losses, optimiser, composition, and a run of a few steps on a stand-in for the generator. About a minute."""

import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
import torch

from stand_in import fake_records
from streetforward import config as cfg
from streetforward import probe, train
from streetforward.batched import Raw, Wanted, forward_clips
from streetforward.calibrate import calibrate_camera
from streetforward.compose import Scene, camera_at, far_shell, gaussians_at, pose_between, sources
from streetforward.data import Batch, Chunks, Loader, Sampler, collate, read_clip
from streetforward.evaluate import Sums, measure
from streetforward.finetune import Schedule, Thaw
from streetforward.folders import read_folder
from streetforward.losses import camera_losses, log_depth_loss, matching_loss, motion_losses, patch_matches, relative
from streetforward.optim import Optimizer, orthogonal
from streetforward.regular import attenuate, depth_loss, opacity_loss, rigid_2d_loss, rigid_3d_loss, symmetry_loss
from streetforward.weights import read_model, scratch_start, write_model

DEMO = Path(__file__).parents[2] / "models" / "demo-clip"


def wall(shift=(0.7, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), height=56, width=84, z=10.0):
    """Two frames a second apart that look at a wall; the second camera stands at `shift`, the wall moves."""
    pose = torch.eye(4, dtype=torch.float64).repeat(1, 2, 1, 1)
    pose[0, 1, :3, 3] = torch.tensor(shift)
    v = torch.tensor(velocity).expand(1, 2, height, width, 3).contiguous()
    depth = torch.full((1, 2, height, width), z)
    times = torch.tensor([[0.0, 1.0]], dtype=torch.float64)
    return Batch(torch.zeros(1, 2, height, width, 3), times, depth, v, pose, torch.tensor([[100.0, 100.0]]).double())


def test_matches_follow_camera_and_surface():
    """0.7 m at 10 m with f = 100 are 7 pixels, half a patch, to the left; a wall that moves along with the camera stays."""
    position, valid, moving = patch_matches(wall(), 14)
    inner = torch.arange(4 * 6).view(4, 6)[:, 1:].flatten()
    row, column = inner // 6, inner % 6
    assert valid[0, 0, inner, 1].all() and not moving.any()
    start = position[0, 0, inner, 0]
    assert torch.allclose(start - torch.stack((row, column), -1), torch.tensor(0.5 / 14), atol=1e-5)
    assert torch.allclose(position[0, 0, inner, 1] - start, torch.tensor([0.0, -0.5]), atol=1e-5)
    position, valid, moving = patch_matches(wall(velocity=(0.7, 0.0, 0.0)), 14)
    assert torch.allclose(position[0, 0, :, 1], position[0, 0, :, 0], atol=1e-5)
    assert not moving.any()
    assert patch_matches(wall(velocity=(1.7, 0.0, 0.0)), 14)[2].all()
    behind = wall()
    behind.depth[0, 1] = 5.0  # hidden: what is seen there is half as far
    assert not patch_matches(behind, 14)[1][0, 0, :, 1].any()


def test_attention_on_the_match_costs_less():
    matches = patch_matches(wall(shift=(1.4, 0.0, 0.0)), 14)  # one whole patch: what patch p shows is at p - 1 later
    same = 6 * torch.eye(24).expand(1, 2, 24, 24)
    moved = same.clone()
    moved[0, 1] = same[0, 1].roll(-1, 0)
    name = "causal.fwd.0"
    right, wrong = (matching_loss([(name, same, keys)], matches, (4, 6))[name] for keys in (moved, same))
    assert right < 1 < 6 < wrong
    # The backward pass looks from the second frame to the first, where everything is one patch to the right.
    name = "causal.bwd.0"
    right, wrong = (matching_loss([(name, queries, same)], matches, (4, 6))[name] for queries in (moved, same))
    assert right < 1 < 6 < wrong


def test_losses_vanish_on_the_truth():
    torch.manual_seed(1)
    batch = wall()
    depth = batch.depth[0]
    value, slope = log_depth_loss(depth.log(), depth)
    assert value < 1e-6 and slope < 1e-6
    turned = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    turned = turned * torch.linalg.det(turned)
    gauge = torch.eye(4, dtype=torch.float64)
    gauge[:3, :3], gauge[:3, 3] = turned, torch.randn(3)
    free = gauge @ batch.pose  # any gauge is right
    rotation, translation = camera_losses(free[..., :3, :3], free[..., :3, 3], batch.pose)
    assert rotation < 1e-6 and translation < 1e-6
    assert camera_losses(free[..., :3, :3], 2 * free[..., :3, 3], batch.pose)[1] > 0.01
    config = cfg.nano()
    v = torch.randn(2, 8, 8, 3) * 5
    moving = v.norm(dim=-1) > 1
    raw = torch.cat((v / 5, torch.where(moving, 50.0, -50.0)[..., None]), -1)
    value, mask = motion_losses(raw, v, torch.ones(2, 8, 8), config)
    assert value < 1e-6 and mask < 1e-6


def test_moving_pixels_are_not_drowned():
    """Ten moving pixels of 40,000 with a wrong speed cost as much as if there were no still ones."""
    config, v = cfg.nano(), torch.zeros(1, 200, 200, 3)
    v[0, 0, :10, 0] = 9.0
    raw = torch.zeros(1, 200, 200, 4)
    value, _ = motion_losses(raw, v, torch.ones(1, 200, 200), config)
    assert value.item() == pytest.approx(10 * 8.5 / 200)


def test_orthogonal_update():
    torch.manual_seed(2)
    o = orthogonal(torch.randn(4, 12, 30))
    assert (torch.linalg.svdvals(o) - 1).abs().max() < 0.35


class Two(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.a = torch.nn.ModuleDict({"attn": torch.nn.ModuleDict({"qkv": torch.nn.Linear(4, 12), "proj": torch.nn.Linear(4, 4)})})
        self.end = torch.nn.Linear(4, 2)


def test_two_ranks_step_as_one():
    """Half of the gradients each, halves of the matrices each: the same weights as one process with all of both."""
    def build():
        torch.manual_seed(3)
        model = Two()
        return model, Optimizer(model, lambda name: True)

    torch.manual_seed(4)
    model, one = build()
    gradients = torch.randn(2, len(one.grads))
    for _ in range(3):
        one.grads.copy_(gradients.mean(0))
        one.step(1.0)
    pair = [build()[1] for _ in range(2)]
    for _ in range(3):
        summed, updates = gradients.sum(0), []
        each = [build()[1] for _ in range(2)]
        for r in range(2):  # first what each rank adds to the exchanged update
            each[r].load(pair[r].state())
            each[r].grads.copy_(gradients[r])

            def collect(t, r=r):
                if len(t) == len(summed):
                    t.copy_(summed)
                else:
                    updates.append(t.clone())

            each[r].step(1.0, r, 2, collect)
        for r in range(2):
            pair[r].grads.copy_(gradients[r])
            pair[r].step(1.0, r, 2, lambda t: t.copy_(summed if len(t) == len(summed) else sum(updates)))
    for rank in pair:
        assert torch.allclose(rank.weights, one.weights, atol=1e-6)
    state = one.state()
    model, fresh = build()
    fresh.load(state)
    assert torch.equal(fresh.weights, one.weights) and fresh.steps == 3
    assert torch.equal(model.end.weight.flatten(), one.weights[one.edge :][: 8]) or model.end.weight.data_ptr()


def test_frozen_parameters_stay():
    model = Two()
    optimizer = Optimizer(model, lambda name: True)
    thaw = Thaw(optimizer, model, Schedule("end.=0,a.=0.5"))
    before = model.a["attn"]["qkv"].weight.clone()
    for fraction, moved in ((0.2, False), (0.6, True)):
        thaw.before(fraction)
        x = model.a["attn"]["qkv"](torch.ones(4))[:4]
        model.end(x).sum().backward()
        optimizer.step(1.0)
        thaw.after()
        assert (model.a["attn"]["qkv"].weight != before).any() == moved
    assert Schedule("gs_=0,point_=0.3").start("camera_head.fc_t.weight") is None


def test_sampler_draws_each_clip_about_reuse_times_and_never_returns():
    sampler = Sampler(5, window=64, reuse=3)
    numbers = [sampler.draw(s)[0] for s in range(3000)]
    assert numbers == [sampler.draw(s)[0] for s in range(3000)]
    counts = np.bincount(numbers)[64:-64]
    assert 2.7 < counts.mean() < 3.3
    assert all(s // 3 <= n < s // 3 + 64 for s, n in enumerate(numbers))


def test_no_rank_waits_for_a_chunk_that_only_it_draws_from(tmp_path, generator):
    """Rank 0 makes all chunks and stops reading while rank 1's gradients are missing."""

    class Apart(Sampler):
        def draw(self, s):
            number, rng = super().draw(s)
            return number % 2 + 4 * (s % 2), rng  # rank 0 from chunk 0, rank 1 from chunk 2

    def loader(rank):
        chunks = Chunks(generator, tmp_path / "cache", "train", 42, 28, count=2)
        return Loader(chunks, Apart(5, window=8, reuse=100), 2, 0, rank, 2, ahead=1)

    ranks = [loader(0), loader(1)]
    ranks[0].queue.get(timeout=120)
    assert ranks[1].queue.get(timeout=120).images.shape[:2] == (1, 4)


def test_mirrored_clips_are_mirrored_streets():
    record = fake_records(1)[0]
    record["pose"][1, :3, :3] = pose_between(torch.eye(4).double(), torch.from_numpy(turn(0.3)), 1.0)[:3, :3]
    plain = read_clip(record)
    rng = next(g for s in range(99) if (g := np.random.default_rng(s)).random() < 0.5 and (g := np.random.default_rng(s)))
    mirrored = read_clip(record, rng)
    flip = np.diag([-1.0, 1, 1, 1])
    assert np.allclose(mirrored[4], flip @ plain[4] @ flip)
    assert np.array_equal(mirrored[2], plain[2][:, :, ::-1])
    assert np.allclose(mirrored[3], plain[3][:, :, ::-1] * [-1, 1, 1], atol=1e-6)
    # Velocities are in each camera's own axes.
    world = record["velocity"][1, -1, -1].astype(float)
    assert np.allclose(plain[3][1, -1, -1], record["pose"][1, :3, :3].T @ world, atol=1e-5)


def turn(angle):
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(angle)
    pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
    return pose


def test_measures_of_the_truth_are_perfect():
    batch = collate([read_clip(r) for r in fake_records(2)])
    turned, shift = (m[:, 0] for m in relative(batch.pose[..., :3, :3], batch.pose[..., :3, 3]))
    fov = (batch.focal / torch.tensor([42, 28])).log()[:, None].expand(2, 4, 2)
    speed = batch.velocity.norm(dim=-1)
    out = {"depth": batch.depth.clamp_min(1), "solid": (batch.depth > 0).float() - 0.5, "turn": turned, "shift": shift}
    out |= {"fov": fov, "velocity": batch.velocity, "dynamic": (speed > 1).float()}
    sums = Sums()
    measure(sums, out, batch)
    result = sums.measures()
    for name in ("abs_rel", "rotation_deg", "travel_error_m", "log_focal", "epe_ratio", "epe_ratio_gated", "false_speed"):
        assert result[name] == pytest.approx(0, abs=1e-6), name
    assert result["sky_iou"] == result["dynamic_iou"] == result["under_1.25"] == 1
    out["velocity"] = torch.zeros_like(batch.velocity)
    sums = Sums()
    measure(sums, out, batch)
    assert sums.measures()["epe_ratio"] == pytest.approx(1)


def test_a_run_resumes_and_learns(tmp_path, generator):
    arguments = ["--out", tmp_path / "run", "--cache", tmp_path, "--generator", generator, "--size", "42x28", "--window", "16"]
    arguments += ["--minutes", "1000", "--motion-from", "0", "--eval-clips", "2", "--log-every", "1", "--batch", "2", "--calibrate", "4"]
    arguments = [str(a) for a in arguments]
    train.main([*arguments, "--steps", "2"])
    train.main([*arguments, "--steps", "5"])
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    steps = [entry for entry in log if "step" in entry]
    assert [entry["step"] for entry in steps] == [1, 2, 3, 4, 5]
    assert [entry["samples"] for entry in steps] == [2, 4, 6, 8, 10]
    assert steps[-1]["depth"] < steps[0]["depth"]
    assert all(name in steps[0] for name in ("velocity", "dynamic", "rotation", "matching.causal.bwd.0", "matching.decoder.3", "displacement.decoder.5"))
    assert [entry["event"] for entry in log if "event" in entry] == ["calibrate", "eval", "resume", "eval"]
    model = read_model(tmp_path / "run" / "ema.safetensors")
    assert model.config == cfg.nano()
    write_model(tmp_path / "half.safetensors", model, torch.float16)
    half = read_model(tmp_path / "half.safetensors")
    assert all((a - b).abs().max() <= 5e-4 * a.abs().max() + 1e-7 for a, b in zip(model.parameters(), half.parameters()))


def test_calibrated_units_live():
    """Every unit behind the average has mean 0 and variance 1 on the clips, and the fits are the best there are."""
    torch.manual_seed(5)
    model = scratch_start(cfg.nano(), 2)
    batches = [collate([read_clip(r) for r in fake_records(4, seed=s)]) for s in range(4)]
    explained = calibrate_camera(model, batches, ridge=1e-6)
    seen = []
    model.camera_head.more_mlps[2].register_forward_hook(lambda module, given, output: seen.append(output))
    errors = []
    with torch.no_grad():
        for batch in batches:
            raw = forward_clips(model, batch.images, batch.times, Wanted())
            errors.append((raw.translation - batch.pose[..., :3, 3]).flatten(0, 1))
    y = torch.cat(seen)
    assert y.mean(0).abs().max() < 1e-3 and (y.std(0) - 1).abs().max() < 1e-2
    truth = torch.cat([b.pose[..., :3, 3] for b in batches]).flatten(0, 1)
    rest = torch.cat(errors).square().sum() / (truth - truth.mean(0)).square().sum()
    assert rest.item() == pytest.approx(1 - explained["fc_t"], abs=1e-3) and explained["fc_t"] > 0.5


def test_displacement_is_what_the_probe_is_asked_for():
    """A wall seen from 1.4 m aside moves by one patch: exact displacements cost nothing, none cost one patch, and the probe learns them."""
    config = cfg.nano()
    matches = patch_matches(wall(shift=(1.4, 0.0, 0.0)), 14)
    told = probe.Probe(("decoder.5", "causal.1"), 2, config)
    tokens = {"decoder.5": torch.zeros(1, 2, 24, 128), "causal.fwd.1": torch.zeros(1, 2, 24, cfg.causal_dim(config))}
    none = probe.displacement_loss(told, tokens, matches)
    assert all(loss.item() == pytest.approx(1 - 0.25, abs=1e-3) for loss in none.values())  # smooth L1 of one patch
    with torch.no_grad():
        told.linear["decoder_5"].bias.copy_(torch.tensor([0.0, 1.0, 0.0, -1.0]))  # (row, column) to frame 0, to frame 1
        told.linear["causal_1"].bias.copy_(torch.tensor([0.0, -1.0]))
    exact = probe.displacement_loss(told, tokens, matches)
    assert all(loss.item() < 1e-6 for loss in exact.values())


def test_the_probe_is_not_shipped(tmp_path):
    model = scratch_start(cfg.nano(), 1)
    names = set(model.state_dict())
    model.add_module(probe.NAME, probe.Probe(train.TELL_STILL + train.TELL_MOTION, 4, model.config))
    write_model(tmp_path / "model.safetensors", model)
    assert set(read_model(tmp_path / "model.safetensors").state_dict()) == names


def test_the_leak_ends():
    """Off units pass a gradient while they leak, and the head is the network's own again when the schedule says so."""
    assert train.leak(0.0) == 0.1 and train.leak(0.3) == pytest.approx(0.05) and train.leak(0.6) == train.leak(1.0) == 0
    head = scratch_start(cfg.nano(), 1).camera_head
    plain = head(torch.ones(1, 4, 128))
    with torch.no_grad():
        head.more_mlps[0].bias.fill_(-100.0)  # every unit behind the average is off
    for slope, alive in ((0.0, False), (0.1, True)):
        head.leak(slope)
        x = torch.ones(1, 4, 128, requires_grad=True)
        head(x)[0].sum().backward()
        assert bool(x.grad.abs().sum() > 0) == alive
    head.leak(0.0)
    with torch.no_grad():
        head.more_mlps[0].bias.zero_()
    assert all(a.shape == b.shape for a, b in zip(plain, head(torch.ones(1, 4, 128))))


def test_the_camera_head_is_cut_by_itself():
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.trunk, self.camera_head = torch.nn.Linear(3, 3), torch.nn.Linear(3, 3)

    optimizer = Optimizer(Model(), lambda name: True, clip=2.0)
    (a, b), = optimizer.parts[True]
    optimizer.grads.fill_(0.1)
    optimizer.grads[a:b] = 100.0
    first = optimizer.first.clone()
    norm = optimizer.step(1.0)
    assert norm == pytest.approx(0.1 * 12**0.5)  # the trunk's gradient stays as it was
    moved = (optimizer.first - first) * 10
    assert moved[a:b].norm().item() == pytest.approx(2.0, rel=1e-4)
    assert torch.allclose(torch.cat((moved[:a], moved[b:])), torch.tensor(0.1))


def test_a_generator_that_fails_is_reported(tmp_path):
    broken = tmp_path / "generator"
    broken.write_text("#!/bin/sh\necho out of streets >&2\nexit 3\n")
    broken.chmod(0o755)
    with pytest.raises(RuntimeError, match="out of streets"):
        Chunks(broken, tmp_path, "train", 42, 28).clip(0)
    assert not list(tmp_path.glob("train*/*"))


def test_an_untrained_gaussian_head_renders_priors():
    model = scratch_start(cfg.nano(), 1)
    head = model.gs_head
    tokens, guide = torch.zeros(1, 8, 128), torch.zeros(1, 16, 14, 28)
    with torch.no_grad():
        raw = head(tokens, (2, 4), guide)
    scale, opacity = raw[..., 4:7].exp() * 0.7, (raw[..., 3] + 2).sigmoid()
    assert torch.allclose(scale, torch.tensor(0.4), atol=0.01) and torch.allclose(opacity, torch.tensor(0.95), atol=0.01)


def little_scene():
    """Three frames a second apart, one dynamic Gaussian each at x = 100 f, and one static."""
    frames = 3
    still = dict(quat=torch.zeros(3, 1, 2, 4), opacity=torch.full((3, 1, 2), 0.8), colour=torch.zeros(3, 1, 2, 3))
    mean = torch.tensor([[0.0, 300], [100, 400], [200, 500]])[:, None, :, None] * torch.tensor([1.0, 0, 0])
    return Scene(
        mean=mean, scale=torch.ones(3, 1, 2, 3), **still, v_fwd=torch.tensor([1.0, 0, 0]).expand(3, 1, 2, 3),
        v_bwd=torch.tensor([-2.0, 0, 0]).expand(3, 1, 2, 3), dynamic=torch.tensor([0.9, 0.1]).expand(3, 1, 2),
        sky=torch.zeros(3, 1, 2, dtype=torch.bool), depth=torch.ones(3, 1, 2), times=torch.arange(3.0).double(),
        pose=torch.eye(4).double().repeat(frames, 1, 1), k=torch.ones(3, 4).double(),
    )  # fmt: skip


def test_composition_is_the_engines():
    """The numbers of `formats/src/scene.rs`, static ones first."""
    scene, config = little_scene(), cfg.nano()

    def xs(time, **rules):
        return gaussians_at(scene, time, config, **rules)["mean"][:, 0].tolist()

    static = [300, 400, 500]
    assert xs(0.25) == [*static, 0.25, 98.5]
    assert xs(1.0) == [*static, 100]
    assert xs(1.0, own=False) == [*static, 1, 198]
    assert xs(2.5) == [*static, 201]
    assert xs(-0.5) == [*static, -0.5]
    assert xs(1.0, without=1) == [300, 500]
    assert xs(1.0, own=False, stage_one=True) == [*static, 100]
    assert sources(scene.times, 0.25, True) == [(0, 0.25, 0.0), (1, 0.0, 0.75)]


def test_a_soft_split_shares_opacity_and_teaches_the_mask():
    scene, config = little_scene(), {**cfg.nano(), "render.split": "soft"}
    scene.dynamic = torch.tensor([0.9, 0.1]).repeat(3, 1, 1).requires_grad_()
    fields = gaussians_at(scene, 1.0, config)
    # All six as static, then frame 1's two as moving ones.
    assert fields["mean"][:, 0].tolist() == [0, 300, 100, 400, 200, 500, 100, 400]
    share = [0.1, 0.9, 0.1, 0.9, 0.1, 0.9, 0.9, 0.1]
    assert torch.allclose(fields["opacity"], 0.8 * torch.tensor(share))
    fields["opacity"][-2:].sum().backward()
    assert scene.dynamic.grad[1].flatten().tolist() == pytest.approx([0.8, 0.8])
    assert scene.dynamic.grad[[0, 2]].abs().sum() == 0
    hard = gaussians_at(scene, 1.0, cfg.nano())["opacity"]
    assert torch.equal(hard, torch.full((4,), 0.8))


def test_cameras_between_frames():
    a, b = torch.from_numpy(turn(0.2)), torch.from_numpy(turn(1.0))
    b[0, 3] = 4
    half = pose_between(a, b, 0.25)
    assert torch.allclose(half[:3, :3], torch.from_numpy(turn(0.4))[:3, :3], atol=1e-12) and half[0, 3] == 1
    assert torch.allclose(pose_between(a, a, 0.5), a)
    scene = little_scene()
    scene.pose[1, 0, 3], scene.pose[2, 0, 3] = 2, 6
    assert camera_at(scene, 0.5)[0][0, 3] == 1 and camera_at(scene, 3.0)[0][0, 3] == 10


def test_sky_goes_to_a_shell():
    depth = torch.tensor([[[10.0, 4.0]]])
    mean, pose = torch.tensor([[[[0.0, 0, 10], [1, 0, 4]]]]), torch.eye(4).double()[None]
    mean, scale, out = far_shell(mean, torch.ones(1, 1, 2, 3), depth, torch.tensor([[[False, True]]]), pose)
    assert mean[0, 0].tolist() == [[0, 0, 10], [5, 0, 20]] and scale[0, 0, 1, 0] == 5 and out[0, 0].tolist() == [False, True]


def test_losses_of_the_paper():
    uniform = torch.tensor([2.0, 0, 1]).expand(1, 4, 5, 3)
    certain = torch.ones(1, 4, 5)
    mean = torch.rand(1, 4, 5, 3)
    assert rigid_2d_loss(uniform, certain) == 0 and rigid_3d_loss(mean, uniform, certain) == 0
    odd = uniform.clone()
    odd[0, 1, 2, 0] += 3
    # One pixel off: 8 of the 55 unordered pairs of a 4x5 window differ, by 9 each.
    assert rigid_2d_loss(odd, certain).item() == pytest.approx(8 * 9 / 55)
    assert rigid_2d_loss(odd, 1 - certain) == 0
    assert rigid_3d_loss(mean, odd, certain, neighbours=3) > 0
    assert symmetry_loss(uniform, -uniform) == 0 and symmetry_loss(uniform, uniform).item() == pytest.approx(6)
    assert opacity_loss(torch.tensor([1.0, 0.5])).item() == pytest.approx(0.125)
    assert depth_loss(torch.tensor([2.0, 9.0]), torch.tensor([3.0, 0.0]), torch.tensor([1.0, 0.0])) == 1
    x = torch.tensor(2.0, requires_grad=True)
    y = attenuate(x, 0.1)
    y.backward()
    assert y == 2 and x.grad.item() == pytest.approx(0.1)


def test_clip_folders_read_like_the_generator():
    record = read_folder(DEMO, (84, 56), range(3))
    assert record["rgb"].shape == (3, 56, 84, 3) and not record["labelled"]
    assert record["k"] == pytest.approx([237.1927734579 / 3, 237.1927734579 / 3, 42, 28])
    assert np.allclose(record["pose"][0], np.eye(4)) and record["pose"][1][2, 3] > 0.5
    image = read_clip(record)[0]
    assert image.shape == (3, 56, 84, 3) and 0.1 < image.mean() < 0.9


def test_log_depth_of_every_depth_map():
    raw = Raw(None, None, None, depth=torch.tensor([[[[1.0, 2.0, 3.0]]]]))
    assert raw.log_depth({"depth.out_map": "pi3_point"}) == 3 and raw.solid({"depth.out_map": "pi3_point"}) is None
    assert raw.log_depth({"depth.out_map": "exp_z_conf"}) == 1 and raw.solid({"depth.out_map": "exp_z_conf"}) == 2


def test_schedule_of_the_rate():
    assert train.learning_rate(0.0, 0) == pytest.approx(1 / 60)
    assert train.learning_rate(0.0, 100) == 1 and train.learning_rate(1.0, 100) == pytest.approx(0.03)
    args = Namespace(depth_frames=2)
    rows = train.choose(3, 4, 1, 3, args.depth_frames, torch.Generator().manual_seed(1)).view(3, 2)
    assert ((rows % 4) > 0).all() and (rows // 4 == torch.arange(3)[:, None]).all()
