"""A stand-in for the clip generator: its layout, random pictures."""

import sys
from pathlib import Path

import numpy as np

from streetforward.data import record_dtype


def fake_records(count, frames=4, height=28, width=42, seed=0):
    rng = np.random.default_rng(seed)
    records = np.zeros(count, record_dtype(frames, height, width))
    records["magic"], records["payload"] = b"SFSYNTH1", records.dtype.itemsize - 64
    records["frames"], records["width"], records["height"] = frames, width, height
    records["k"] = [40, 40, width / 2, height / 2]
    records["times"] = 0.5 * np.arange(frames)
    records["pose"] = np.eye(4)
    records["pose"][:, :, 2, 3] = 2.0 * np.arange(frames)
    records["rgb"] = rng.integers(0, 255, records["rgb"].shape)
    records["depth"] = rng.uniform(2, 40, records["depth"].shape)
    records["depth"][:, :, : height // 4] = 0
    records["velocity"][:, :, -5:, -9:] = [3, 0, 1]
    return records


GENERATOR = """#!{python}
import sys
sys.path[:0] = {path!r}
from stand_in import fake_records
split, first, count, size = sys.argv[1:5]
width, height = (int(n) for n in size.split("x"))
frames = int(sys.argv[5]) if len(sys.argv) > 5 else 4
sys.stdout.buffer.write(fake_records(int(count), frames, height, width, seed=int(first) + len(split)).tobytes())
"""


def write_generator(folder):
    """An executable that writes random streets in the generator's layout."""
    path = folder / "generator"
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    path.write_text(GENERATOR.format(python=sys.executable, path=folders))
    path.chmod(0o755)
    return path
