"""Clip folders as `streetforward synth` writes them, as the records that the loader reads.

A folder holds pictures, `transforms.json` (OpenGL camera axes, times in seconds), `depth/NAME.npy` (f32 z-depth, 0 is sky) and
`velocity/NAME.npy` (f32, world axes, units per second). Depth and velocity may be missing: such clips train the losses
that need no label.
"""

import json
from pathlib import Path

import numpy as np

OPENGL = np.diag([1.0, -1, -1, 1])


def read_folder(path, size, frames=None):
    """A record of the folder's frames (all, or the chosen numbers) at size (W, H).

    Colour shrinks by area, depth and velocity by the nearest pixel: an average across an edge is nobody's depth.
    """
    from PIL import Image

    path = Path(path)
    table = json.loads((path / "transforms.json").read_text())
    rows = table["frames"] if frames is None else [table["frames"][f] for f in frames]
    width, height = size
    if not rows:
        raise ValueError(f"{path}: no frames")
    record = {"rgb": [], "depth": [], "velocity": [], "pose": [], "times": [], "labelled": True}
    for i, row in enumerate(rows):
        name = Path(row["file_path"])
        with Image.open(path / name) as picture:
            record["rgb"].append(np.asarray(picture.convert("RGB").resize(size, Image.Resampling.BOX)))
            full = picture.size
        y = ((np.arange(height) + 0.5) * full[1] / height).astype(int)
        x = ((np.arange(width) + 0.5) * full[0] / width).astype(int)
        for key, shape in (("depth", ()), ("velocity", (3,))):
            file = path / key / f"{name.stem}.npy"
            if file.exists():
                values = np.load(file)
                if values.shape != (full[1], full[0], *shape):
                    raise ValueError(f"{file}: shape {values.shape} does not fit a picture of {full[0]}x{full[1]}")
                record[key].append(values[y[:, None], x])
            else:
                record["labelled"] = False
                record[key].append(np.zeros((height, width, *shape), np.float32))
        record["pose"].append(np.array(row["transform_matrix"], float) @ OPENGL)
        record["times"].append(row.get("time", i / 10))
    record = {key: np.stack(value) if isinstance(value, list) else value for key, value in record.items()}
    # The labels' world is the first camera, as the generator's records have it.
    first = record["pose"][0]
    record["velocity"] = record["velocity"] @ first[:3, :3].astype(np.float32)
    record["pose"] = np.linalg.inv(first) @ record["pose"]
    sx, sy = width / table["w"], height / table["h"]
    record["k"] = np.array([table["fl_x"] * sx, table["fl_y"] * sy, table["cx"] * sx, table["cy"] * sy])
    return record


class Folders:
    """Clip folders under a parent, numbered by name, instead of the generator's chunks."""

    count = 1

    def __init__(self, parent, width, height, frames=None):
        self.size, self.frames = (width, height), frames
        self.paths = sorted(p.parent for p in Path(parent).glob("**/transforms.json"))
        if not self.paths:
            raise ValueError(f"{parent}: no clip folder (transforms.json) inside")

    def clip(self, number, wait=False):
        return read_folder(self.paths[number % len(self.paths)], self.size, self.frames)

    def make(self, i):
        """Nothing to make."""
