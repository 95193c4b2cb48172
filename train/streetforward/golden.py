"""The golden cases: tiny networks that together touch every convention, and their inputs.

Every case changes several settings of one small network; widths, counts and sizes differ between cases so that a
mixed-up dimension cannot go unnoticed. Times are never uniform and never start at zero.
"""

from dataclasses import dataclass, field

import numpy as np

from .config import dpt_head, full, guided_head, linear_head, no_head, trunk


@dataclass
class Case:
    """One golden file."""

    name: str
    seed: int
    frames: int
    rows: int  # patches
    columns: int
    changes: dict = field(default_factory=dict)

    def config(self):
        return tiny() | self.changes

    def times(self):
        return 12.25 + np.array([0.0, 0.1, 0.35, 0.5])[: self.frames]

    def images(self):
        patch = self.config()["patch"]
        return street_pictures(self.seed, self.frames, self.rows * patch, self.columns * patch)


def street_pictures(seed, frames, height, width):
    """Smooth waves that drift from frame to frame, plus noise: u8 [F, H, W, 3]."""
    rng = np.random.Generator(np.random.PCG64(seed))
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    pictures = np.empty((frames, height, width, 3))
    waves = rng.uniform(-9, 9, size=(3, 4, 2))
    phase = rng.uniform(0, 2 * np.pi, size=(3, 4))
    for f in range(frames):
        for c in range(3):
            sum_of_waves = sum(np.sin(a * x + b * y + p + 0.4 * f) for (a, b), p in zip(waves[c], phase[c]))
            pictures[f, :, :, c] = 0.5 + 0.15 * sum_of_waves
    pictures += rng.normal(0, 0.04, size=pictures.shape)
    return np.clip(np.round(255 * pictures), 0, 255).astype(np.uint8)


def aa(dim, heads):
    """Encoder and alternating stack of one width."""
    return {
        **trunk("encoder", dim, 2, heads, registers=4),
        **trunk("aa", dim, 4, heads, registers=3),
        "encoder.mlp_ratio": 2,
        "aa.mlp_ratio": 3,
    }


def tiny():
    """The network that the cases change: width 16, two encoder and four alternating layers, linear heads."""
    return full() | {
        "patch": 4,
        **aa(16, 2),
        "encoder.pos_grid": 5,
        "camera.dim": 12,
        "camera.depth": 1,
        "camera.heads": 3,
        "camera.width": 12,
        **linear_head("depth", 3, 12, 1, 1),
        **no_head("conf"),
        **linear_head("gs", 11, 16, 1, 2),
        "time.d_t": 8,
        "causal.depth": 2,
        "causal.heads": 2,
        **linear_head("motion", 4, 12, 1, 1),
    }


CASES = [
    Case(
        "linear", 1, frames=2, rows=2, columns=3,
        changes={
            "patch": 14,
            **aa(24, 2),
            **linear_head("conf", 1, 8, 1, 2),
            "conf.eps": 1e-3,
            **linear_head("gs", 11, 8, 1, 1),
            **linear_head("motion", 4, 8, 1, 2),
        },
    ),
    Case(
        "dpt", 2, frames=4, rows=3, columns=5,
        changes={
            "patch": 4,
            **trunk("encoder", 16, 2, 4, registers=1),
            **trunk("aa", 16, 8, 2, registers=5),
            "aa.mlp_ratio": 2,
            **dpt_head("gs", 11, [0, 1, 2, 3], [8, 12, 8, 16], 16, hidden=8),
            "gs.eps": 1e-2,
            "time.d_t": 12,
            "causal.depth": 4,
            "causal.heads": 1,
            **dpt_head("motion", 4, [0, 1, 2, 3], [12, 8, 16, 4], 8, hidden=12),
            "motion.scale": 3.0,
            "motion.bias": -1.0,
        },
    ),
    Case(
        "depth_dpt", 3, frames=2, rows=4, columns=3,
        changes={
            "patch": 5,
            **dpt_head("depth", 1, [0, 1, 1, 0], [4, 8, 12, 8], 8, hidden=4),
            "depth.out_map": "exp_z",
            "depth.rcu_skip": "raw",
            **dpt_head("conf", 1, [1, 0, 1, 1], [4, 4, 4, 8], 8, hidden=4),
            "camera.k": "fov",
            "camera.pixel": "integer",
            **linear_head("gs", 11, 12, 2, 3),
        },
    ),
    Case(
        "strict_mask", 4, frames=4, rows=3, columns=4,
        changes={"mask.self": False, "mask.k": 2, **aa(16, 4), "causal.heads": 6, "world.scale": 2.5},
    ),
    Case(
        "figure", 5, frames=4, rows=2, columns=5,
        changes={
            **aa(12, 1),
            "time.d_t": 16,
            "causal.heads": 1,
            "mask.orientation": "figure",
            "motion.back_sign": -1,
            "render.extrapolate": "direct",
            "encoder.eps": 1e-3,
            "aa.eps": 1e-2,
            "motion.eps": 1e-3,
        },
    ),
    Case(
        "single_pass", 6, frames=3, rows=3, columns=3,
        changes={**linear_head("motion", 7, 16, 2, 1), "motion.layout": "single_pass", "motion.bias": 0.5},
    ),
    Case(
        "order", 7, frames=4, rows=3, columns=2,
        changes={
            "aa.order": "global_first",
            "aa.time": True,
            "time.base": 500.0,
            "time.unit": 0.25,
            "head.concat": "last",
            "causal.in": "frame_global",
            "causal.registers": True,
            "causal.heads": 5,
            **aa(16, 4),
            "aa.registers": 2,
            **dpt_head("gs", 11, [1, 0, 0, 1], [4, 8, 4, 8], 8, hidden=4),
            "image.mean": [0.4, 0.5, 0.45],
            "image.std": [0.25, 0.3, 0.2],
        },
    ),
    Case(
        "two_sets", 8, frames=4, rows=2, columns=4,
        changes={
            "causal.share": False,
            "camera.k": "fit_frame",
            "motion.frame": "world",
            "motion.per": "step",
            "motion.combine": "max",
            "mask.k": 2,
            "world.scale": 0.5,
            **dpt_head("motion", 4, [1, 0, 1, 0], [4, 8, 4, 12], 8, hidden=8),
            "motion.rcu_skip": "raw",
        },
    ),
    Case(
        "dggt", 9, frames=2, rows=2, columns=7,
        changes={
            **aa(16, 1),
            "gs.out_map": "dggt",
            **dpt_head("depth", 3, [0, 1, 0, 1], [4, 4, 8, 4], 8, hidden=8),
            "depth.eps": 1e-2,
            "camera.k": "fov",
            "rope.angle_round": "bf16",
            "rope.base": 5.0,
            "world.anchor": "raw",
            "world.scale": 3.0,
            "motion.per": "step",
            **dpt_head("gs", 11, [1, 0, 0, 1], [8, 4, 8, 4], 8, hidden=4),
            "aa.qk_eps": 1e-2,
        },
    ),
    Case(
        "pi3", 10, frames=3, rows=2, columns=3,
        changes={
            "patch": 6,
            **linear_head("conf", 1, 16, 2, 2),
            **no_head("gs"),
            "time.d_t": 0,
            "causal.depth": 0,
            "causal.heads": 0,
            **no_head("motion"),
            "camera.depth": 2,
        },
    ),
    Case(
        "one_frame", 11, frames=1, rows=3, columns=4,
        changes={
            "patch": 14,
            **dpt_head("gs", 11, [0, 0, 1, 1], [4, 8, 8, 4], 8, hidden=8),
            **linear_head("motion", 4, 4, 1, 1),
        },
    ),
    Case(
        "guided", 13, frames=3, rows=3, columns=4,
        changes={
            "patch": 6,
            "guide.channels": 6,
            "aa.time": True,
            "camera.k": "fov",
            **guided_head("depth", 2, 12, 1, 3, hidden=8, features=10),
            "depth.out_map": "exp_z_conf",
            **guided_head("gs", 11, 8, 1, 1, hidden=5, features=12),
            **guided_head("motion", 4, 16, 1, 2, hidden=6, features=8),
            "motion.back_sign": -1,
            "motion.scale": 5.0,
            "motion.bias": -2.0,
            "motion.eps": 1e-2,
            "sky.mode": "far_shell",
            "sky.conf": 0.5,
        },
    ),
    Case(
        "guided_conf", 14, frames=3, rows=2, columns=3,
        changes={
            "patch": 14,
            "guide.channels": 3,
            "head.concat": "last",
            **guided_head("conf", 1, 8, 1, 2, hidden=4, features=6),
            **guided_head("gs", 11, 8, 0, 2, hidden=3, features=9),
            **guided_head("motion", 7, 12, 1, 3, hidden=4, features=5),
            "motion.layout": "single_pass",
            "causal.registers": True,
            "mask.k": 0,
        },
    ),
    Case(
        "native_grid", 12, frames=2, rows=5, columns=5,
        changes={
            **trunk("encoder", 20, 1, 1, registers=0),
            **trunk("aa", 20, 2, 5, registers=0),
            "time.d_t": 4,
            "mask.k": 3,
            "camera.depth": 0,
            **linear_head("depth", 3, 8, 0, 1),
        },
    ),
]
