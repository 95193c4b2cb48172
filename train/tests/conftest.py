"""Shared pieces: the folder on the path, one thread, and a tiny network with nothing at zero."""

import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from streetforward.golden import CASES  # noqa: E402
from streetforward.weights import golden_model  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture
def case():
    """Cases of the golden tensors by name."""
    return {c.name: c for c in CASES}


@pytest.fixture
def run():
    """Runs a case, its settings changed, in f64: stages by name."""

    def run(case, frames=None, **changes):
        changes = {key.replace("__", "."): value for key, value in changes.items()}
        model = golden_model(case.config() | changes, case.seed).double()
        images, times = torch.from_numpy(case.images()), torch.from_numpy(case.times())
        if frames is not None:
            images, times = images[frames], times[frames]
        stages = {}
        with torch.no_grad():
            model(images, times, stages)
        return stages

    return run


@pytest.fixture
def generator(tmp_path):
    """A stand-in for the clip generator: random pictures in its layout."""
    from stand_in import write_generator

    return write_generator(tmp_path)
