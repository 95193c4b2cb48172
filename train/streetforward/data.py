"""Clips for training: streamed from the generator in Rust, cached as files, sampled by number, augmented.

A chunk file is (by default) 256 records of the generator's binary stream (`synth/src/stream.rs`), all of one size, so that it maps
into memory as one structured array. Chunk i holds the split's clips with seeds from 4096 i on: the same bytes anywhere.
"""

import os
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

import numpy as np
import torch

CHUNK = 256
SEED_STRIDE = 4096  # a split takes about every second seed: 256 of its seeds always fit
MAGIC = b"SFSYNTH1"
FAR = 150.0  # metres; where the generator's depth ends


def record_dtype(frames, height, width):
    """One clip as the generator writes it."""
    pixels = (frames, height, width)
    return np.dtype(
        [
            ("magic", "S8"),
            ("seed", "<u8"),
            ("payload", "<u4"),
            ("frames", "<u4"),
            ("width", "<u4"),
            ("height", "<u4"),
            ("k", "<f8", 4),
            ("times", "<f8", frames),
            ("pose", "<f8", (frames, 4, 4)),
            ("rgb", "u1", (*pixels, 3)),
            ("depth", "<f2", pixels),
            ("id", "<u2", pixels),
            ("velocity", "<f2", (*pixels, 3)),
        ]
    )


class Chunks:
    """Chunk files of one split and size in a folder, made on demand by the generator."""

    def __init__(self, generator, folder, split, width, height, frames=4, stride=None, count=CHUNK, threads=1):
        self.generator, self.split, self.size, self.threads = Path(generator), split, (width, height), threads
        self.frames = frames
        self.count = count  # clips of a chunk
        self.timing = [] if stride is None else [frames, stride]  # without a stride each seed has its own
        self.dtype = record_dtype(frames, height, width)
        timing = "".join(f"-{n}" for n in self.timing) + (f"-by{count}" if count != CHUNK else "")
        self.folder = Path(folder) / f"{split}-{width}x{height}{timing}"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.maps, self.lock, self.making = {}, threading.Lock(), threading.Lock()

    def path(self, i):
        return self.folder / f"{i:06}.bin"

    def make(self, i):
        """Writes chunk i if it is not there; whole or not at all."""
        with self.making:
            self.write(i)

    def write(self, i):
        path = self.path(i)
        if path.exists():
            return
        partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
        command = [self.generator, self.split, i * SEED_STRIDE, self.count, f"{self.size[0]}x{self.size[1]}", *self.timing]
        environment = os.environ | {"RAYON_NUM_THREADS": str(self.threads)}
        with open(partial, "wb") as out:
            done = subprocess.run(
                [str(c) for c in command], stdout=out, stderr=subprocess.PIPE, env=environment, check=False
            )
        expected = self.count * self.dtype.itemsize
        if done.returncode or partial.stat().st_size != expected:
            size = partial.stat().st_size
            partial.unlink()
            raise RuntimeError(f"{self.generator}: {size} of {expected} bytes: {done.stderr.decode().strip()}")
        partial.replace(path)

    def chunk(self, i, wait=False):
        """Chunk i as a structured array. `wait` leaves the making to another process."""
        with self.lock:
            if i not in self.maps:
                while wait and not self.path(i).exists():
                    time.sleep(0.2)
                self.make(i)
                mapped = np.memmap(self.path(i), self.dtype, "r")
                if mapped[0]["magic"] != MAGIC or int(mapped[0]["payload"]) + 64 != self.dtype.itemsize:
                    raise RuntimeError(f"{self.path(i)} is not a chunk of clips of this size")
                self.maps[i] = mapped
                if len(self.maps) > 64:
                    self.maps.pop(next(iter(self.maps)))
            return self.maps[i]

    def clip(self, number, wait=False):
        return self.chunk(number // self.count, wait)[number % self.count]


@dataclass
class Sampler:
    """Which clip is training sample number s: a draw from a window that moves one clip every `reuse` samples.

    A clip is drawn `reuse` times on average and then never again. The draw depends on the seed and s alone, so a run
    resumes exactly from its sample count.
    """

    seed: int
    window: int = 1024
    reuse: float = 3.0
    offset: int = 0  # number of the first clip: another offset, other streets

    def draw(self, s):
        """Number of the clip and the generator of its augmentation."""
        rng = np.random.Generator(np.random.PCG64([self.seed, s]))
        return self.first(s) + int(rng.integers(self.window)), rng

    def first(self, s):
        """Smallest number that sample s may draw."""
        return self.offset + int(s / self.reuse)

    def last(self, s):
        """Largest number that sample s may draw."""
        return self.first(s) + self.window - 1


@dataclass
class Batch:
    """B clips: images f32 in 0..1 and times for the network, the rest for the losses."""

    images: torch.Tensor  # [B, F, H, W, 3]
    times: torch.Tensor  # f64 [B, F]
    depth: torch.Tensor  # f32 [B, F, H, W], metres; 0 is sky
    velocity: torch.Tensor  # f32 [B, F, H, W, 3], axes of each frame's camera, m/s
    pose: torch.Tensor  # f64 [B, F, 4, 4], camera to world
    focal: torch.Tensor  # f64 [B, 2], pixels

    def frames(self, chosen):
        """The clips with these frames alone."""
        return Batch(*(v if name == "focal" else v[:, chosen] for name, v in vars(self).items()))

    def to(self, device):
        return Batch(*(value.to(device, non_blocking=True) for value in vars(self).values()))


def read_clip(record, rng=None):
    """A record as arrays, augmented when a generator is given: mirror, gain per channel, gamma; the same for all frames.

    Never reversed in time: that a camera car drives forward is worth knowing.
    """
    rgb, depth = record["rgb"], record["depth"].astype(np.float32)
    velocity, pose = record["velocity"].astype(np.float32), record["pose"].copy()
    table = np.arange(256, dtype=np.float32)[:, None].repeat(3, 1) / 255
    if rng is not None:
        mirror, gain, gamma = rng.random() < 0.5, rng.uniform(0.85, 1.15, 3), rng.uniform(0.8, 1.25)
        table = np.clip(table**gamma * gain, 0, 1).astype(np.float32)
        if mirror:
            rgb, depth, velocity = rgb[:, :, ::-1], depth[:, :, ::-1], velocity[:, :, ::-1] * [-1, 1, 1]
            flip = np.diag([-1.0, 1, 1, 1])
            pose = flip @ pose @ flip
    image = np.stack([table[:, c][rgb[..., c]] for c in range(3)], axis=-1)
    moving = np.flatnonzero(np.abs(velocity).sum(axis=(1, 2, 3)))
    in_camera = np.zeros(velocity.shape, np.float32)
    for f in moving:  # rows times R is R^T v
        in_camera[f] = velocity[f] @ pose[f, :3, :3].astype(np.float32)
    return image, record["times"].copy(), np.ascontiguousarray(depth), in_camera, pose, record["k"][:2].copy()


def collate(clips):
    return Batch(*(torch.from_numpy(np.stack(values)) for values in zip(*clips)))


class Loader:
    """Batches in the sampler's order from a sample count on, read ahead by a thread.

    With several ranks rank r takes clips r, r + ranks, ... of each batch; rank 0 makes the chunks, ahead of their use.
    """

    def __init__(self, chunks, sampler, batch, start=0, rank=0, ranks=1, ahead=2):
        self.chunks, self.sampler, self.batch, self.rank, self.ranks = chunks, sampler, batch, rank, ranks
        self.queue, self.front = Queue(ahead), start
        threading.Thread(target=self.guard, args=(self.read, start), daemon=True).start()
        if rank == 0:
            threading.Thread(target=self.guard, args=(self.make_ahead, start), daemon=True).start()

    def guard(self, work, start):
        try:
            work(start)
        except BaseException as error:  # the reader's error belongs to whoever waits for a batch
            self.queue.put(error)
            raise

    def read(self, s):
        while True:
            clips = []
            for i in range(self.rank, self.batch, self.ranks):
                number, rng = self.sampler.draw(s + i)
                clips.append(read_clip(self.chunks.clip(number, wait=self.rank > 0), rng))
            self.queue.put(collate(clips))
            s += self.batch

    def make_ahead(self, start):
        # From the window's first clip on: another rank may wait for a chunk that this one does not draw from, and this one for it.
        made = self.sampler.first(start) // self.chunks.count * self.chunks.count
        while True:
            if made <= self.sampler.last(self.front) + self.chunks.count:
                self.chunks.make(made // self.chunks.count)
                made += self.chunks.count
            else:
                time.sleep(1)

    def next(self):
        item = self.queue.get()
        if isinstance(item, BaseException):
            raise item
        self.front += self.batch
        return item


def held_out(chunks, count, step=0.5):
    """The first `count` held-out clips whose frames are `step` seconds apart: records."""
    found, i = [], 0
    while len(found) < count:
        chunk = chunks.chunk(i)
        found += [clip for clip in chunk if abs(clip["times"][1] - clip["times"][0] - step) < 1e-6]
        i += 1
    return found[:count]
