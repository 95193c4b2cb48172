"""Our rasterizer beside CPU renderers in PyTorch, in turns in one process, on the procedural street of `splat`'s examples.

    cargo build --release -p sf-capi
    cargo run --release -p sf-splat --example rates -- ply STREETS
    python bench/peers/raster.py STREETS -o raster.md

* `ours`: image, depth and coverage through the C interface, two threads.
* `tiles`: the same rules as tensor operations: sorted once, then for every 32x32 tile a dense pixels x Gaussians block of
  alphas and their running product, as PyTorch-only splat renderers do. All of its Gaussians, no early end.
* `gsplat projection`: gsplat's own PyTorch code (package `gsplat`), which runs on the CPU up to the projection only; what it costs is
  a floor of a picture by that package.

Every picture is compared with ours before anything is timed.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "train"))
from streetforward.raster import rasterize  # noqa: E402

STEP = 4.5  # metres between the street's source frames; the view is between the second and the third
SIZES = ((252, 168), (518, 280), (1280, 720))
AGREE = 60.0  # dB against ours: the same picture up to f32 sums and cuts
TILE = 32


def read_ply(path):
    """Means, quaternions, scales, opacities, colours of a splat file, f32."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    table = np.frombuffer(data, np.float32, count * len(names), end).reshape(count, -1)

    def columns(*wanted):
        return torch.from_numpy(table[:, [names.index(n) for n in wanted]].copy())

    return {
        "means": columns("x", "y", "z"),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "scales": columns("scale_0", "scale_1", "scale_2").exp(),
        "opacities": columns("opacity")[:, 0].sigmoid(),
        "colours": 0.5 + 0.28209479177387814 * columns("f_dc_0", "f_dc_1", "f_dc_2"),
    }


def camera(width, height):
    """World to camera, and fx, fy, cx, cy."""
    view = torch.eye(4, dtype=torch.float64)
    view[2, 3] = -1.5 * STEP
    return view, (0.8 * width, 0.8 * width, width / 2, height / 2)


def ours(g, size):
    view, k = camera(*size)
    return rasterize(g["means"], g["quats"], g["scales"], g["opacities"], g["colours"], view, *k, *size)


def project(g, size):
    """Centres [N, 2], conics [N, 3], depths, box half-widths [N, 2] and fields of what may be seen, front to back."""
    view, (fx, fy, cx, cy) = camera(*size)
    view = view.float()
    p = g["means"] @ view[:3, :3].T + view[:3, 3]
    near = p[:, 2] >= 0.01
    p, g = p[near], {name: value[near] for name, value in g.items()}
    x, y, z = p.unbind(-1)
    w, i, j, k = torch.nn.functional.normalize(g["quats"], dim=-1).unbind(-1)
    turn = torch.stack(
        (
            1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j),
            2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i),
            2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j),
        ),
        dim=-1,
    ).unflatten(-1, (3, 3))
    m = view[:3, :3] @ (turn * g["scales"][:, None])
    tan_x, tan_y = size[0] / (2 * fx), size[1] / (2 * fy)
    xz = (x / z).clamp(-(cx / fx + 0.3 * tan_x), (size[0] - cx) / fx + 0.3 * tan_x)
    yz = (y / z).clamp(-(cy / fy + 0.3 * tan_y), (size[1] - cy) / fy + 0.3 * tan_y)
    o = torch.zeros_like(z)
    jacobian = torch.stack((fx / z, o, -fx * xz / z, o, fy / z, -fy * yz / z), dim=-1).unflatten(-1, (2, 3))
    jm = jacobian @ m
    s = jm @ jm.mT + 0.3 * torch.eye(2)
    a, b, c = s[:, 0, 0], s[:, 0, 1], s[:, 1, 1]
    det = a * c - b * b
    reach = (2 * (255 * g["opacities"]).clamp_min(1).log()).sqrt()[:, None] * torch.stack((a, c), -1).sqrt()
    centre = torch.stack((fx * x / z + cx, fy * y / z + cy), dim=-1)
    seen = (det > 0) & (g["opacities"] >= 1 / 255) & ((centre + reach) > 0).all(-1) & ((centre - reach) < torch.tensor(size)).all(-1)
    order = seen.nonzero()[:, 0]
    order = order[z[order].argsort(stable=True)]
    conic = torch.stack((c / det, -b / det, a / det), dim=-1)
    value = torch.cat((g["colours"], z[:, None], torch.ones_like(z)[:, None]), dim=-1)
    return [t[order] for t in (centre, conic, reach, g["opacities"], value)]


def tiles(g, size):
    width, height = size
    centre, conic, reach, opacity, value = project(g, size)
    low, high = centre - reach, centre + reach
    out = torch.zeros(height, width, 5)
    for y0 in range(0, height, TILE):
        y1 = min(y0 + TILE, height)
        row = ((high[:, 1] > y0) & (low[:, 1] < y1)).nonzero()[:, 0]
        for x0 in range(0, width, TILE):
            x1 = min(x0 + TILE, width)
            n = row[(high[row, 0] > x0) & (low[row, 0] < x1)]
            ys, xs = torch.meshgrid(torch.arange(y0, y1) + 0.5, torch.arange(x0, x1) + 0.5, indexing="ij")
            t_start = torch.ones((y1 - y0) * (x1 - x0), 1)
            total = torch.zeros(len(t_start), 5)
            for part in n.split(512):  # blocks of this length were fastest
                dx = xs.reshape(-1, 1) - centre[part, 0]
                dy = ys.reshape(-1, 1) - centre[part, 1]
                power = -0.5 * (conic[part, 0] * dx * dx + conic[part, 2] * dy * dy) - conic[part, 1] * dx * dy
                alpha = (opacity[part] * power.exp()).clamp_max(0.999)
                alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
                t = t_start * (1 - alpha).cumprod(1)
                before = torch.cat((t_start, t[:, :-1]), dim=1)
                weight = torch.where(t > 1e-4, before * alpha, 0.0)
                total += weight @ value[part]
                t_start = t[:, -1:]
            out[y0:y1, x0:x1] = total.reshape(y1 - y0, x1 - x0, 5)
    return out[..., :3], out[..., 3], out[..., 4]


def gsplat_projection():
    """gsplat's projection in PyTorch, or None with the reason."""
    try:
        from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
    except Exception as error:  # whatever importing it on a machine without CUDA raises is the answer
        return None, f"{type(error).__name__}: {error}"

    def run(g, size):
        view, (fx, fy, cx, cy) = camera(*size)
        k = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])[None]
        covariance, _ = _quat_scale_to_covar_preci(g["quats"], g["scales"], True, False, triu=False)
        return _fully_fused_projection(g["means"], covariance, view.float()[None], k, *size)

    return run, ""


def psnr(a, b):
    error = (a.double() - b.double()).square().mean().item()
    return float("inf") if error == 0 else -10 * np.log10(error)


def main():
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("streets", type=Path, help="folder with the streets as PLY")
    p.add_argument("-o", type=Path, help="Markdown file; standard output without it")
    p.add_argument("--view", action="append", help="W x H of pictures, such as 252x168; repeated; without it all three")
    p.add_argument("--seconds", type=float, default=6, help="time for each renderer and view")
    args = p.parse_args()
    sizes = [tuple(int(n) for n in v.split("x")) for v in args.view] if args.view else SIZES
    torch.set_num_threads(2)
    projection, why = gsplat_projection()
    lines = ["| Gaussians | view | ours ms | tiles in PyTorch ms | ratio | PSNR to ours dB | gsplat projection ms | ratio |", "|---|---|---|---|---|---|---|---|"]
    with torch.no_grad():
        for path in sorted(args.streets.glob("*.ply")):
            g = read_ply(path)
            for size in sizes:
                peers = {"tiles": tiles} | ({"gsplat": projection} if projection else {})
                truth, same = ours(g, size)[0], psnr(tiles(g, size)[0], ours(g, size)[0])
                if not same >= AGREE:
                    sys.exit(f"{path.name} {size}: the pictures differ, {same:.1f} dB; {AGREE} are asked")
                times = {name: [] for name in ("ours", *peers)}
                end = time.perf_counter() + args.seconds * len(times)
                while time.perf_counter() < end or len(times["tiles"]) < 3:
                    for _ in range(5):
                        began = time.perf_counter()
                        image = ours(g, size)[0]
                        times["ours"].append(1e3 * (time.perf_counter() - began))
                    assert torch.equal(image, truth)
                    for name, peer in peers.items():
                        began = time.perf_counter()
                        peer(g, size)
                        times[name].append(1e3 * (time.perf_counter() - began))
                ms = {name: statistics.median(values) for name, values in times.items()}
                extra = f"{ms['gsplat']:.0f} | {ms['gsplat'] / ms['ours']:.1f}" if projection else "- | -"
                lines.append(
                    f"| {len(g['means'])} | {size[0]}x{size[1]} | {ms['ours']:.1f} | {ms['tiles']:.0f} | {ms['tiles'] / ms['ours']:.0f} | {same:.0f} | {extra} |"
                )
                print(lines[-1], file=sys.stderr, flush=True)
    if why:
        lines += ["", f"gsplat: {why}"]
    text = "\n".join(lines) + "\n"
    if args.o:
        args.o.write_text(text)
    else:
        print(text, end="")


if __name__ == "__main__":
    main()
