"""Configuration: one flat dictionary of dotted keys.

The keys and defaults are those of `formats/src/config.rs`. The same dictionary travels as JSON in a checkpoint's
metadata under `streetforward.config`, so a checkpoint describes its own network.
"""

import json

METADATA_KEY = "streetforward.config"


def trunk(prefix, dim, depth, heads, registers):
    return {
        f"{prefix}.dim": dim,
        f"{prefix}.depth": depth,
        f"{prefix}.heads": heads,
        f"{prefix}.registers": registers,
        f"{prefix}.mlp_ratio": 4,
        f"{prefix}.eps": 1e-6,
    }


def no_head(prefix):
    return {
        f"{prefix}.kind": "none",
        f"{prefix}.out": 0,
        f"{prefix}.dim": 0,
        f"{prefix}.depth": 0,
        f"{prefix}.heads": 0,
        f"{prefix}.taps": [],
        f"{prefix}.channels": [],
        f"{prefix}.features": 0,
        f"{prefix}.hidden": 0,
        f"{prefix}.rcu_skip": "relu",
        f"{prefix}.eps": 1e-5,
        f"{prefix}.image_merger": "none",
    }


def linear_head(prefix, out, dim, depth, heads):
    """Pi3's kind: decoder of `depth` blocks, one linear layer, pixel shuffle."""
    return no_head(prefix) | {
        f"{prefix}.kind": "xdec_linear",
        f"{prefix}.out": out,
        f"{prefix}.dim": dim,
        f"{prefix}.depth": depth,
        f"{prefix}.heads": heads,
        f"{prefix}.eps": 1e-6,
    }


def guided_head(prefix, out, dim, depth, heads, hidden, features):
    """Pi3's decoder, then convolutions at half resolution that also see the image; sharp edges at small width."""
    return linear_head(prefix, out, dim, depth, heads) | {
        f"{prefix}.kind": "guided",
        f"{prefix}.features": features,
        f"{prefix}.hidden": hidden,
    }


def dpt_head(prefix, out, taps, channels, features, hidden=32):
    """VGGT's kind: a fusion pyramid over four taps."""
    return no_head(prefix) | {
        f"{prefix}.kind": "dpt",
        f"{prefix}.out": out,
        f"{prefix}.taps": list(taps),
        f"{prefix}.channels": list(channels),
        f"{prefix}.features": features,
        f"{prefix}.hidden": hidden,
    }


def full():
    """The faithful size: ViT-L encoder and 36 alternating layers."""
    return {
        "patch": 14,
        "image.mean": [0.485, 0.456, 0.406],
        "image.std": [0.229, 0.224, 0.225],
        "image.resample": "bicubic",
        "image.size": [],
        **trunk("encoder", 1024, 24, 16, registers=4),
        "encoder.pos_grid": 37,
        **trunk("aa", 1024, 36, 16, registers=5),
        "aa.qk_eps": 1e-5,
        "aa.order": "frame_first",
        "aa.time": False,
        "rope.base": 100.0,
        "rope.angle_round": "none",
        "head.concat": "frame_global",
        "guide.channels": 0,
        "camera.dim": 1024,
        "camera.depth": 5,
        "camera.heads": 16,
        "camera.width": 512,
        "camera.k": "fit_shared",
        "camera.pixel": "half",
        **linear_head("depth", 3, 1024, 5, 16),
        "depth.out_map": "pi3_point",
        **linear_head("conf", 1, 1024, 5, 16),
        **dpt_head("gs", 11, [3, 8, 12, 17], [256, 512, 1024, 1024], 256),
        "gs.out_map": "residual",
        "time.d_t": 128,
        "time.base": 10000.0,
        "time.unit": 0.1,
        "causal.depth": 4,
        "causal.heads": 16,
        "causal.in": "last",
        "causal.registers": False,
        "causal.share": True,
        "mask.orientation": "equation",
        "mask.self": True,
        "mask.k": 1,
        **dpt_head("motion", 4, [0, 1, 2, 3], [256, 512, 1024, 1024], 256),
        "motion.layout": "per_direction",
        "motion.frame": "camera",
        "motion.per": "second",
        "motion.back_sign": 1,
        "motion.scale": 1.0,
        "motion.bias": 0.0,
        "motion.combine": "mean",
        "motion.tau": 0.5,
        "world.anchor": "first",
        "world.scale": 1.0,
        "render.window": 1,
        "render.self": "own",
        "render.extrapolate": "mirror",
        "render.split": "hard",
        "static.voxel": 0.0,
        "sky.mode": "none",
        "sky.conf": 0.1,
        "splat.aa": False,
        "splat.a_max": 0.999,
        "splat.eps2d": 0.3,
        "splat.near": 0.01,
    }


def base():
    """ViT-S encoder and 24 alternating layers, about 110 M parameters."""
    return full() | {
        **trunk("encoder", 384, 12, 6, registers=4),
        **trunk("aa", 384, 24, 6, registers=5),
        "camera.dim": 384,
        "camera.depth": 4,
        "camera.heads": 6,
        "camera.width": 256,
        **linear_head("depth", 3, 384, 4, 6),
        **linear_head("conf", 1, 384, 4, 6),
        **dpt_head("gs", 11, [2, 5, 8, 11], [48, 96, 192, 384], 64),
        "time.d_t": 64,
        "causal.heads": 7,
        **dpt_head("motion", 4, [0, 1, 2, 3], [48, 96, 192, 384], 64),
    }


def nano():
    """About 4.2 M parameters: the network that is trained from scratch on generated streets."""
    return full() | {
        "image.size": [168, 112],
        **trunk("encoder", 128, 4, 2, registers=4),
        "encoder.pos_grid": 16,
        **trunk("aa", 128, 6, 2, registers=5),
        "aa.time": True,
        "guide.channels": 16,
        "camera.dim": 128,
        "camera.depth": 1,
        "camera.heads": 2,
        "camera.width": 128,
        "camera.k": "fov",
        **guided_head("depth", 2, 128, 1, 2, hidden=24, features=32),
        "depth.out_map": "exp_z_conf",
        **no_head("conf"),
        **guided_head("gs", 11, 128, 1, 2, hidden=24, features=32),
        "time.d_t": 32,
        "causal.depth": 2,
        "causal.heads": 4,
        **guided_head("motion", 4, 128, 1, 2, hidden=24, features=32),
        "motion.back_sign": -1,
        "motion.scale": 5.0,
        "motion.bias": -2.0,
        "sky.mode": "far_shell",
        "sky.conf": 0.5,
        "splat.eps2d": 0.1,
    }


def pi3():
    """Public Pi3: `full` without Gaussian head, causal module and motion."""
    return full() | {
        "image.resample": "lanczos",
        **no_head("gs"),
        "time.d_t": 0,
        "causal.depth": 0,
        "causal.heads": 0,
        **no_head("motion"),
    }


def preset(name):
    """The preset of a name: `nano`, `base`, `full` or `pi3`."""
    presets = {"nano": nano, "base": base, "full": full, "pi3": pi3}
    if name not in presets:
        raise ValueError(f"preset {name!r} is unknown; known: {', '.join(presets)}")
    return presets[name]()


def with_linear_heads(config):
    """The same network with its Gaussian, motion and guided heads of the `xdec_linear` kind."""
    changed = dict(config) | {"guide.channels": 0}
    for prefix in ("depth", "conf", "gs", "motion"):
        if config[f"{prefix}.kind"] == "guided" or prefix in ("gs", "motion") and config[f"{prefix}.kind"] != "none":
            width = [config[f"depth.{key}"] for key in ("dim", "depth", "heads")]
            changed |= linear_head(prefix, config[f"{prefix}.out"], *width)
    return changed


def head_in(config):
    """Channels of the features that the camera and the heads with a decoder read."""
    return config["aa.dim"] * (2 if config["head.concat"] == "frame_global" else 1)


def causal_dim(config):
    """Channels D' inside the causal module: features plus time embedding."""
    return config["aa.dim"] * (2 if config["causal.in"] == "frame_global" else 1) + config["time.d_t"]


def guided(config):
    """Whether any head sees the image."""
    return any(config[f"{prefix}.kind"] == "guided" for prefix in ("depth", "conf", "gs", "motion"))


def has_motion(config):
    return config["causal.depth"] > 0 and config["motion.kind"] != "none"


def to_json(config):
    return json.dumps(config, sort_keys=True)


def from_json(text):
    """A configuration from its JSON; keys that are not ours are an error, missing ones take `base`'s value."""
    read = json.loads(text)
    unknown = sorted(set(read) - set(base()))
    if unknown:
        raise ValueError(f"configuration key {unknown[0]} is unknown")
    return base() | read
