"""What a training run leaves in its folder: a line of JSON per event, and a checkpoint to resume from."""

import json
import math
import time

import torch


def note(args, **entry):
    """Appends to `log.jsonl` and prints; rank 0 speaks for all."""
    if args.rank == 0:
        entry = {"at": time.strftime("%H:%M:%S"), **entry}
        text = json.dumps({k: round(v, 5) if isinstance(v, float) and math.isfinite(v) else v for k, v in entry.items()})
        with open(args.out / "log.jsonl", "a") as file:
            file.write(text + "\n")
        print(text, flush=True)


def save(run):
    """`resume.pt`: optimiser with weights and their average, samples seen, seconds spent. The draws follow from the samples."""
    if run.args.rank == 0:
        path = run.args.out / "resume.pt"
        state = {"optimizer": run.optimizer.state(), "samples": run.samples, "elapsed": run.elapsed}
        torch.save(state, path.with_suffix(".partial"))
        path.with_suffix(".partial").replace(path)


def resume(run):
    """Takes up the checkpoint of the run's folder if there is one."""
    path = run.args.out / "resume.pt"
    if path.exists():
        state = torch.load(path, weights_only=True)
        run.optimizer.load(state["optimizer"])
        run.samples, run.elapsed = state["samples"], state["elapsed"]
        note(run.args, event="resume", samples=run.samples, elapsed=run.elapsed)
