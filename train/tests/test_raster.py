"""The rasterizer's images and gradients against a dense renderer in plain PyTorch, and an optimisation through it."""

import math
import os

import pytest
import torch

raster = pytest.importorskip("streetforward.raster")
try:
    raster._shared()
except FileNotFoundError as missing:
    pytest.skip(str(missing), allow_module_level=True)

from streetforward.raster import RasterError, rasterize  # noqa: E402

WIDTH, HEIGHT = 26, 18
K = (22.0, 23.0, 12.5, 9.5)


def rotation(quats):
    """Matrices [N, 3, 3] of quaternions [N, 4] of any length."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def dense(means, quats, scales, opacities, colours, view, antialiased=False, a_max=0.999, background=(0.0, 0.0, 0.0)):
    """Every Gaussian at every pixel; the rules of docs/rasterizer.md, differentiated by PyTorch."""
    fx, fy, cx, cy = K
    p = means @ view[:3, :3].T + view[:3, 3]
    order = p[:, 2].detach().to(torch.float32).sort(stable=True).indices
    p, scales, opacities, colours = p[order], scales[order], opacities[order], colours[order]
    x, y, z = p.unbind(-1)
    margin = (0.15 * WIDTH / fx, 0.15 * HEIGHT / fy)
    tx = (x / z).clamp(-(cx / fx + margin[0]), (WIDTH - cx) / fx + margin[0])
    ty = (y / z).clamp(-(cy / fy + margin[1]), (HEIGHT - cy) / fy + margin[1])
    zero = torch.zeros_like(z)
    jacobian = torch.stack((fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z), dim=-1).reshape(-1, 2, 3)
    root = jacobian @ view[:3, :3] @ rotation(quats[order]) * scales[:, None, :]
    sharp = root @ root.transpose(1, 2)
    covariance = sharp + 0.3 * torch.eye(2, dtype=sharp.dtype)
    if antialiased:
        opacities = opacities * (sharp.det() / covariance.det()).clamp_min(0.005**2).sqrt()
    centre = torch.stack((fx * x / z + cx, fy * y / z + cy), dim=-1)
    u, v = torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5
    pixels = torch.stack((u.expand(HEIGHT, -1), v[:, None].expand(-1, WIDTH)), dim=-1).reshape(-1, 1, 2)
    offset = pixels.to(sharp.dtype) - centre
    sigma = 0.5 * torch.einsum("pni,nij,pnj->pn", offset, covariance.inverse(), offset)
    alpha = (opacities * (-sigma).exp()).clamp_max(a_max)
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
    after = (1 - alpha).cumprod(-1)
    # The Gaussian that would take T to 1e-4 and all behind it are left out.
    alpha = torch.where((after <= 1e-4).cumsum(-1) == 0, alpha, torch.zeros_like(alpha))
    after = (1 - alpha).cumprod(-1)
    weight = alpha * torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), dim=-1)
    rgb = weight @ colours + after[:, -1:] * torch.tensor(background, dtype=weight.dtype)
    shape = (HEIGHT, WIDTH)
    return rgb.reshape(*shape, 3), (weight @ z).reshape(shape), (1 - after[:, -1]).reshape(shape)


def scene(seed, count):
    """Gaussians in front of a tilted camera, some of them opaque and large; f64."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape, lo=0.0, hi=1.0):
        # Numbers of f32, so that both sides draw the same scene.
        return (lo + (hi - lo) * torch.rand(*shape, generator=g)).to(torch.float64)

    z = rand(count, lo=2, hi=6)
    means = torch.stack((rand(count, lo=-0.7, hi=0.7) * z, rand(count, lo=-0.5, hi=0.5) * z, z), dim=-1)
    scales = rand(count, 3, lo=0.05, hi=0.4)
    opacities = rand(count, lo=0.05, hi=0.95)
    scales[::4], opacities[::4] = scales[::4] * 3, 1
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = rotation(torch.tensor([[1.0, 0.03, -0.05, 0.02]], dtype=torch.float64))[0]
    view[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    means = means.to(torch.float32).double()
    return [means, rand(count, 4, lo=-1), scales, opacities, rand(count, 3), view]


def leaves(inputs, dtype=torch.float64):
    return [t.detach().clone().to(dtype if t.shape != (4, 4) else torch.float64).requires_grad_() for t in inputs]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_images_and_gradients_are_those_of_a_dense_renderer(seed, antialiased):
    options = {"antialiased": antialiased, "background": (0.2, 0.7, 0.4)}
    inputs = scene(seed, 40)
    exact, fast = leaves(inputs), leaves(inputs, torch.float32)
    want, got = dense(*exact, **options), rasterize(*fast, *K, WIDTH, HEIGHT, **options)
    assert want[2].max() > 0.99 and want[2].min() < 0.9
    g = torch.Generator().manual_seed(100 + seed)
    weights = [torch.randn(w.shape, generator=g) for w in want]
    # Pixels on which f32 decides otherwise than f64 about a cut have no part.
    same = (got[0] - want[0]).abs().amax(-1) < 1e-5
    assert same.double().mean() > 0.98
    for a, b in zip(got, want):
        torch.testing.assert_close(a.double()[same], b[same], atol=1e-4, rtol=1e-5)
    for images, dtype in ((want, torch.float64), (got, torch.float32)):
        masks = (same[..., None], same, same)
        sum((image * (w * m).to(dtype)).sum() for image, w, m in zip(images, weights, masks)).backward()
    for name, a, b in zip(("means", "quats", "scales", "opacities", "colours", "view"), fast, exact):
        worst = (a.grad - b.grad).abs().max() / b.grad.abs().max()
        assert worst < 1e-3, f"{name}: {worst:.1e}"
        assert b.grad.abs().max() > 0


def pixels_apart(a, b, view):
    """Median distance on the screen of two sets of centres."""

    def seen(means):
        p = means.detach().double() @ view[:3, :3].T + view[:3, 3]
        return p[:, :2] / p[:, 2:] * torch.tensor(K[:2])

    return (seen(a) - seen(b)).norm(dim=-1).median()


def test_colour_alone_moves_positions():
    """Thirty steps on L_rgb: centres that were moved come back."""
    inputs = scene(7, 30)
    inputs[3] = torch.full_like(inputs[3], 0.7)
    target = dense(*inputs)[0].float()
    means, *rest = (t.float() for t in inputs)
    g = torch.Generator().manual_seed(8)
    moved = (means + 0.1 * torch.randn(means.shape, generator=g) * torch.tensor([1.0, 1.0, 0.0])).requires_grad_()
    optimizer = torch.optim.Adam([moved], lr=0.02)
    losses, start = [], pixels_apart(moved, means, inputs[5])
    for _ in range(30):
        optimizer.zero_grad()
        loss = (rasterize(moved, *rest, *K, WIDTH, HEIGHT)[0] - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0], losses
    assert pixels_apart(moved, means, inputs[5]) < 0.5 * start


def test_views_in_flight_keep_their_own_image():
    inputs = scene(3, 40)
    shifted = inputs[5].clone()
    shifted[0, 3] += 0.5

    def gradient(views):
        *tensors, _ = leaves(inputs, torch.float32)
        images = [rasterize(*tensors, view, *K, WIDTH, HEIGHT)[0].square().sum() for view in views]
        sum(images).backward()
        return tensors[0].grad

    both = gradient([inputs[5], shifted])
    torch.testing.assert_close(both, gradient([inputs[5]]) + gradient([shifted]), atol=1e-5, rtol=1e-5)
    # A graph can be gone through again, and what nobody asks for is not computed.
    means, *rest = (t.float() for t in inputs)
    means.requires_grad_()
    _, depth, _ = rasterize(means, *rest, *K, WIDTH, HEIGHT)
    first = torch.autograd.grad(depth.sum(), means, retain_graph=True)[0]
    again = torch.autograd.grad(depth.sum(), means)[0]
    assert torch.equal(first, again) and first.abs().max() > 0


def test_any_number_of_threads_gives_the_same_bits():
    inputs = scene(5, 200)
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            raster._rasters = None
            tensors = leaves(inputs, torch.float32)
            images = rasterize(*tensors, *K, WIDTH, HEIGHT)
            sum(image.square().sum() for image in images).backward()
            results.append([*images, *(t.grad for t in tensors)])
    finally:
        torch.set_num_threads(before)
        raster._rasters = None
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_a_forked_process_draws_too():
    """Data loaders fork: the child has none of the parent's threads and must not wait for them."""
    inputs = [t.float() for t in scene(5, 50)]
    want, _, _ = rasterize(*inputs, *K, WIDTH, HEIGHT)
    child = os.fork()
    if child == 0:
        same = False
        try:
            same = torch.equal(rasterize(*inputs, *K, WIDTH, HEIGHT)[0], want)
        finally:
            os._exit(0 if same else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_wrong_calls_are_refused():
    inputs = [t.float() for t in scene(1, 5)]
    with pytest.raises(ValueError, match="quats"):
        rasterize(inputs[0], inputs[2], *inputs[2:], *K, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="fx"):
        rasterize(*inputs, torch.tensor(20.0, requires_grad=True), *K[1:], WIDTH, HEIGHT)
    with pytest.raises(RasterError, match="a_max") as refused:
        rasterize(*inputs, *K, WIDTH, HEIGHT, a_max=1.0)
    assert refused.value.status == 3
    with pytest.raises(RasterError, match="limit of 2"):
        rasterize(*inputs, *K, WIDTH, HEIGHT, max_entries=2)
    means = inputs[0].clone().requires_grad_()
    rgb, _, _ = rasterize(means, *inputs[1:], *K, WIDTH, HEIGHT)
    with pytest.raises(RasterError, match="not a finite number"):
        (rgb.sum() * math.inf).backward()


def test_nothing_to_draw_is_the_background():
    empty = [torch.zeros(0, n) for n in (3, 4, 3)]
    rgb, depth, alpha = rasterize(
        *empty, torch.zeros(0), torch.zeros(0, 3), torch.eye(4), *K, WIDTH, HEIGHT, background=(0.1, 0.2, 0.3)
    )
    assert torch.equal(rgb, torch.tensor([0.1, 0.2, 0.3]).expand(HEIGHT, WIDTH, 3))
    assert not depth.any() and not alpha.any()
