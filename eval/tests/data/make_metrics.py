"""Writes metrics.json: PSNR and SSIM of two small pictures by scikit-image.

    pip install numpy scikit-image && python make_metrics.py
"""

import json
import pathlib

import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

HEIGHT, WIDTH = 21, 26
rng = np.random.default_rng(7)
y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
clean = np.stack([128 + 90 * np.sin(0.4 * x + 0.2 * c) * np.cos(0.3 * y) for c in range(3)], axis=-1)
a = np.clip(np.round(clean), 0, 255).astype(np.uint8)
b = np.clip(np.round(clean * 0.9 + 8 + rng.normal(0, 14, clean.shape)), 0, 255).astype(np.uint8)
mask = (x - 6) ** 2 + (y - 4) ** 2 < 60

fa, fb = a / 255.0, b / 255.0
mean, full = structural_similarity(fa, fb, data_range=1.0, channel_axis=-1, full=True)
out = {
    "width": WIDTH,
    "height": HEIGHT,
    "a": a.ravel().tolist(),
    "b": b.ravel().tolist(),
    "mask": mask.ravel().astype(int).tolist(),
    "psnr": peak_signal_noise_ratio(fa, fb, data_range=1.0),
    "psnr_masked": float(-10 * np.log10(np.mean((fa - fb)[mask] ** 2))),
    "ssim": float(mean),
    "ssim_masked": float(full[mask].mean()),
    "ssim_map_corner": full[0, 0].tolist(),
}
path = pathlib.Path(__file__).with_name("metrics.json")
path.write_text(json.dumps(out, separators=(",", ":")) + "\n")
