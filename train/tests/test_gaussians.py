"""Cameras, unprojection, Gaussian and motion maps."""

import pytest
import torch

from streetforward import config as cfg
from streetforward import gaussians as g
from streetforward.heads import nearest_rotation


def camera_points(fx, fy, height, width, depth):
    """Local points of a camera with a centred principal point."""
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    x, y = (u + 0.5 - width / 2) / fx, (v + 0.5 - height / 2) / fy
    return torch.stack((x, y, torch.ones_like(x)), dim=-1) * depth[..., None]


def some_pose():
    turn = nearest_rotation(torch.tensor([[0.9, -0.2, 0.3, 0.3, 0.9, -0.1, -0.2, 0.1, 0.9]]))
    return g.raw_poses(turn, torch.tensor([[0.5, -1.0, 2.0]]))


def test_the_fit_returns_the_camera_the_rays_come_from():
    torch.manual_seed(1)
    depth = 1 + 9 * torch.rand(2, 6, 10).double()
    points = camera_points(13.0, 11.0, 6, 10, depth)
    for source in ("fit_shared", "fit_frame"):
        k = g.intrinsics(points, None, cfg.base() | {"camera.k": source})
        assert torch.allclose(k, torch.tensor([13.0, 11.0, 5.0, 3.0]).double().expand(2, 4), atol=1e-10)


def test_field_of_view_channels_are_logarithms_of_relative_focal_lengths():
    points = torch.ones(1, 6, 10, 1)
    k = g.intrinsics(points, torch.tensor([[0.0, 1.0]]), cfg.base() | {"camera.k": "fov"})
    assert torch.allclose(k[0], torch.tensor([10.0, 6 * 2.718281828459045, 5.0, 3.0]).double())


def test_world_points_reproject_to_their_own_pixels_by_both_routes():
    torch.manual_seed(2)
    depth = 1 + 9 * torch.rand(1, 6, 10).double()
    pose, k = some_pose(), torch.tensor([[13.0, 11.0, 5.0, 3.0]]).double()
    world = g.unproject(depth, k, pose, cfg.base())
    # Camera-to-world turned round is the paper's world-to-camera (R, t): R (mu) + t, then K.
    rotation = pose[0, :3, :3].T
    translation = -rotation @ pose[0, :3, 3]
    local = world[0] @ rotation.T + translation
    assert torch.allclose(local, camera_points(13.0, 11.0, 6, 10, depth)[0], atol=1e-12)
    assert torch.allclose(local[..., 0] / local[..., 2] * 13 + 5 - 0.5, torch.arange(10.0).double().expand(6, 10))
    assert torch.allclose(torch.einsum("ji,hwj->hwi", rotation, local - translation), world[0], atol=1e-12)


def test_integer_pixels_shift_the_rays_by_half_a_pixel():
    depth, pose = torch.ones(1, 4, 4).double(), torch.eye(4).double()[None]
    k = torch.tensor([[2.0, 4.0, 2.0, 2.0]]).double()
    half = g.unproject(depth, k, pose, cfg.base())
    whole = g.unproject(depth, k, pose, cfg.base() | {"camera.pixel": "integer"})
    assert torch.allclose(half - whole, torch.tensor([0.25, 0.125, 0.0]).double().expand(1, 4, 4, 3))


def test_the_first_camera_becomes_the_world():
    pose = torch.cat((some_pose(), some_pose() @ some_pose()))
    anchored = g.anchored_poses(pose, cfg.base() | {"world.scale": 3.0})
    assert torch.allclose(anchored[0], torch.eye(4).double(), atol=1e-14)
    expected = some_pose()[0].clone()
    expected[:3, 3] *= 3
    assert torch.allclose(anchored[1], expected, atol=1e-14)


def turn_by(q, vector):
    """Rotates a vector by a quaternion through the Hamilton product."""
    conjugate = q * torch.tensor([1.0, -1, -1, -1], dtype=q.dtype)
    return g.hamilton(g.hamilton(q, torch.cat((vector.new_zeros(1), vector))), conjugate)[1:]


def test_quaternions_turn_as_their_matrices():
    torch.manual_seed(3)
    rotations = nearest_rotation(torch.randn(100, 9))
    half_turns = torch.diag_embed(torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1]]).double())
    for rotation in torch.cat((rotations, half_turns)):
        q, v = g.quaternion(rotation[None])[0], torch.tensor([0.3, -0.5, 0.8]).double()
        assert torch.allclose(turn_by(q, v), rotation @ v, atol=1e-12)


def test_zero_channels_give_the_priors():
    image, depth = torch.rand(1, 2, 2, 3).double(), torch.full((1, 2, 2), 6.0).double()
    k = torch.tensor([[8.0, 12.0, 1.0, 1.0]]).double()
    raw = torch.zeros(1, 2, 2, 11).double()
    config = cfg.base() | {"world.scale": 2.0}
    colour, opacity, scale, quat = g.gaussian_maps(raw, image, depth, k, some_pose(), config)
    assert torch.equal(colour, image)
    assert torch.allclose(opacity, torch.tensor(1 / (1 + 2.718281828459045**-2)).double().expand(1, 2, 2))
    assert torch.allclose(scale, torch.full((1, 2, 2, 3), 2 * 0.7 * 6 / 10).double())
    v = torch.tensor([0.3, -0.5, 0.8]).double()
    assert torch.allclose(turn_by(quat[0, 0, 0], v), some_pose()[0, :3, :3] @ v, atol=1e-12)
    assert (quat[..., 0] >= 0).all()


def test_the_scale_residual_is_clamped():
    raw = torch.zeros(1, 1, 1, 11).double()
    raw[..., 4:7] = torch.tensor([9.0, -9.0, 1.0])
    k = torch.tensor([[0.7, 0.7, 0.5, 0.5]]).double()
    one = torch.ones(1, 1, 1).double()
    scale = g.gaussian_maps(raw, torch.zeros(1, 1, 1, 3).double(), one, k, some_pose(), cfg.base())[2]
    assert torch.allclose(scale.log(), torch.tensor([4.0, -4.0, 1.0]).double())


TIMES = torch.tensor([0.0, 0.1, 0.4], dtype=torch.float64)


def motion(config_changes, velocity_fwd=1.0, velocity_bwd=10.0, logit=(0.0, 2.0)):
    """Motion maps of constant raw channels, the frame number added to the velocity, at the identity pose."""
    frame = torch.arange(3.0).double()[:, None, None, None].expand(3, 1, 1, 3)
    column = torch.ones(3, 1, 1, 1).double()
    raw = {
        "fwd": torch.cat((velocity_fwd + frame, logit[0] * column), dim=-1),
        "bwd": torch.cat((velocity_bwd + frame, logit[1] * column), dim=-1),
    }
    pose = torch.eye(4).double().repeat(3, 1, 1)
    ahead, behind, dynamic = g.motion_maps(raw, TIMES, pose, cfg.base() | config_changes)
    return ahead[:, 0, 0, 0].tolist(), behind[:, 0, 0, 0].tolist(), dynamic[:, 0, 0]


def test_a_missing_direction_mirrors_the_other():
    ahead, behind, _ = motion({})
    assert ahead == [1, 2, -12]
    assert behind == [-1, 11, 12]
    ahead, behind, _ = motion({"render.extrapolate": "direct"})
    assert ahead == [1, 2, 3]
    assert behind == [10, 11, 12]


def test_sign_scale_and_unit_of_velocity():
    ahead, behind, _ = motion({"motion.back_sign": -1, "motion.scale": 2.0, "world.scale": 0.5})
    assert ahead == [1, 2, 12]
    assert behind == [-1, -11, -12]
    ahead, behind, _ = motion({"motion.per": "step", "render.extrapolate": "direct"})
    assert ahead == pytest.approx([1 / 0.1, 2 / 0.3, 3 / 0.3])
    assert behind == pytest.approx([10 / 0.1, 11 / 0.1, 12 / 0.3])


def test_probabilities_of_known_directions_combine():
    half, most = 0.5, 1 / (1 + 2.718281828459045**-2)
    assert motion({})[2].tolist() == pytest.approx([half, (half + most) / 2, most])
    assert motion({"motion.combine": "max"})[2].tolist() == pytest.approx([half, most, most])
    assert motion({"motion.bias": -2.0})[2][2] == pytest.approx(0.5)


def test_camera_axes_turn_with_the_camera():
    turn = some_pose().repeat(3, 1, 1)
    raw = {way: torch.tensor([1.0, 2.0, 3.0, 0.0]).double().expand(3, 1, 1, 4) for way in ("fwd", "bwd")}
    in_camera = g.motion_maps(raw, TIMES, turn, cfg.base())[0][0, 0, 0]
    in_world = g.motion_maps(raw, TIMES, turn, cfg.base() | {"motion.frame": "world"})[0][0, 0, 0]
    assert in_world.tolist() == [1, 2, 3]
    assert torch.allclose(in_camera, turn[0, :3, :3] @ in_world)


def test_confidence_cuts_priors_only_far_from_its_threshold(case, run):
    stages = run(case["pi3"])
    probability = stages["conf"].sigmoid()
    cut = stages["out.opacity"] == 0
    assert torch.equal(cut, probability < 0.1)
    assert 0.05 < cut.double().mean() < 0.95
    assert (probability - 0.1).abs().min() > 1e-4
