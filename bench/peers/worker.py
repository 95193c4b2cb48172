"""One process of the comparison: a runtime with one network or one operation, run by lines on standard input.

    python worker.py '{"runtime": "onnxruntime", "kind": "network", "model": "nano.onnx", ...}'

The same lines as worker/src/main.rs: `ready` after the first run; `run N` prints the nanoseconds of N runs; `save DIR`
writes the outputs of the last run as .npy. What cannot run here prints `cannot REASON` and ends. Only the runtime in use
is imported, so that memory and start belong to it.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


class Cannot(Exception):
    """This runtime cannot run that here; the text says why."""


def has_bf16():
    try:
        flags = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags


# --- runtimes: each returns a function that runs once and returns {name: array} ---


def onnxruntime_model(spec, feed):
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = spec["threads"]
    options.inter_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 3
    session = ort.InferenceSession(spec["model"], options, providers=["CPUExecutionProvider"])
    wanted = {i.name for i in session.get_inputs()}
    feed = {name: value for name, value in feed.items() if name in wanted}
    names = [o.name for o in session.get_outputs()]
    return lambda: dict(zip(names, session.run(names, feed)))


def openvino_config(spec):
    hint = spec.get("hint", "f32")
    return {
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": "1",
        "INFERENCE_NUM_THREADS": str(spec["threads"]),
        "INFERENCE_PRECISION_HINT": hint,
    }


def openvino_model(spec, feed):
    import openvino as ov

    core = ov.Core()
    if spec.get("hint") == "bf16" and "BF16" not in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
        raise Cannot("this CPU has no bfloat16 instructions")
    model = spec["built"] if "built" in spec else core.read_model(spec["model"])
    request = core.compile_model(model, "CPU", openvino_config(spec)).create_infer_request()
    inputs = {i.any_name for i in request.model_inputs}
    feed = {name: value for name, value in feed.items() if name in inputs}
    names = [o.any_name if o.names else str(i) for i, o in enumerate(request.model_outputs)]

    def run():
        request.infer(feed, share_inputs=True)
        return {name: request.get_output_tensor(i).data for i, name in enumerate(names)}

    return run


def torch_setup(spec):
    import torch

    torch.set_num_threads(spec["threads"])
    torch.set_grad_enabled(False)
    if spec["precision"] == "bf16" and not has_bf16():
        raise Cannot("this CPU has no bfloat16 instructions")
    return torch


def torch_quantized(torch, module, spec):
    """The module in the precision asked for."""
    if spec["precision"] == "bf16":
        return module.to(torch.bfloat16)
    if spec["precision"] == "int8":
        from torch.ao.quantization import quantize_dynamic

        torch.backends.quantized.engine = spec.get("engine", "x86")
        return quantize_dynamic(module, {torch.nn.Linear}, dtype=torch.qint8)
    return module


def torch_network(spec, feed):
    torch = torch_setup(spec)
    sys.path.insert(0, str(ROOT / "train"))
    from streetforward.graph import Graph, constants
    from streetforward.weights import read_model

    images = torch.from_numpy(feed["images"])
    graph = Graph(read_model(spec["checkpoint"]), *images.shape[:3]).eval()
    graph = torch_quantized(torch, graph, spec)
    time_input = torch.from_numpy(feed["time"]).to(graph.places.dtype)

    def run():
        with constants():
            return dict(zip(graph.names, (t.float().numpy() for t in graph(images, time_input))))

    return run


def network(spec):
    feed = {"images": np.load(spec["images"]), "time": np.load(spec["time"])}
    make = {"onnxruntime": onnxruntime_model, "openvino": openvino_model, "pytorch": torch_network}
    return make[spec["runtime"]](spec, feed)


def file(spec):
    """A small exported graph on one random input `x`."""
    x = np.random.default_rng(1).standard_normal(spec["shape"], dtype=np.float32)
    make = {"onnxruntime": onnxruntime_model, "openvino": openvino_model}
    return make[spec["runtime"]](spec, {"x": x})


def block(spec):
    """A transformer block in PyTorch."""
    torch = torch_setup(spec)
    from parts import BlockPart

    part = torch_quantized(torch, BlockPart(spec["tokens"]).eval(), spec)
    x = torch.randn(*spec["shape"], generator=torch.Generator().manual_seed(1))
    x = x.to(torch.bfloat16) if spec["precision"] == "bf16" else x
    return lambda: {"y": part(x).float().numpy()}


def op(spec):
    """One operation built in place."""
    import ops

    return ops.build(spec, torch_setup, openvino_model, onnxruntime_model)


def serve(spec):
    make = {"network": network, "file": file, "block": block, "op": op}[spec["kind"]]
    run = make(spec)
    last = run()
    print("ready", flush=True)
    for line in sys.stdin:
        command, _, rest = line.strip().partition(" ")
        if command == "run":
            times = []
            for _ in range(int(rest)):
                start = time.perf_counter_ns()
                last = run()
                times.append(time.perf_counter_ns() - start)
            print(*times, flush=True)
        elif command == "save":
            for name, value in last.items():
                np.save(Path(rest) / f"{name}.npy", value)
            print("saved", flush=True)
        else:
            raise ValueError(f"{line!r} is no command")


if __name__ == "__main__":
    # What libraries print must not come between the lines of the protocol.
    protocol = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    sys.stdout = protocol
    sys.path.insert(0, str(HERE))
    try:
        serve(json.loads(sys.argv[1]))
    except Cannot as why:
        print(f"cannot {why}", flush=True)
