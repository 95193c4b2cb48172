"""Writes resample.txt: Pillow's 8-bit resize of a fixed pattern, as the oracle of resize::resample_u8.

Usage: python resample.py > resample.txt
"""
import numpy as np
import PIL
from PIL import Image

FILTERS = {"bicubic": Image.BICUBIC, "lanczos": Image.LANCZOS, "bilinear": Image.BILINEAR}
# (w, h) -> (dw, dh): down, up, mixed, odd, one axis only, extreme.
SIZES = [((16, 12), (7, 5)), ((5, 4), (11, 9)), ((13, 6), (6, 13)), ((9, 7), (9, 3)), ((9, 7), (4, 7)),
         ((31, 17), (14, 14)), ((3, 3), (1, 1)), ((1, 2), (5, 5))]


def pattern(w, h):
    v = ((np.arange(w * h * 3, dtype=np.uint64) * 2654435761) & 0xFFFFFFFF) >> 24
    v = np.where(v % 4 == 0, 0, np.where(v % 4 == 1, 255, v))
    return v.astype(np.uint8).reshape(h, w, 3)


print(f"# Pillow {PIL.__version__}; filter w h dw dh, then RGB in hex")
for name, kind in FILTERS.items():
    for (w, h), (dw, dh) in SIZES:
        out = np.asarray(Image.fromarray(pattern(w, h)).resize((dw, dh), kind))
        print(name, w, h, dw, dh)
        print(out.tobytes().hex())
