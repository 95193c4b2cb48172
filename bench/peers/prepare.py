"""Files that the runtimes load: checkpoint, blobs, ONNX and OpenVINO graphs in f32 and int8.

Made once and kept; delete the folder to make them again. Every step runs in a process of its own (the exporter and the
quantizers keep what they took).
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT / "train"))


def step(name, *args):
    """A function of this file in its own process; its last line when it fails, else None."""
    code = [sys.executable, str(HERE / "prepare.py"), name, *map(str, args)]
    done = subprocess.run(code, capture_output=True, text=True)
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.strip().splitlines() if line.strip()]
    return lines[-1][:300] if lines else f"ended with status {done.returncode}"


def made(path, name, *args):
    """Makes `path` by a step unless it is there and no older than its source, the step's first argument; the reason when it cannot be made."""
    path, source = Path(path), Path(str(args[0]))
    if path.exists() and not (source.is_file() and source.stat().st_mtime > path.stat().st_mtime):
        return None
    why = step(name, *args)
    return why if why else None if path.exists() else f"{name} wrote no file"


def onnx_network(checkpoint, frames, width, height, path):
    from streetforward.graph import Graph, export_onnx
    from streetforward.weights import read_model

    export_onnx(Graph(read_model(checkpoint), int(frames), int(height), int(width)), path)


def onnx_block(batch, tokens, path):
    import torch
    from parts import DIM, BlockPart

    part = BlockPart(int(tokens)).eval()
    x = torch.zeros(int(batch), int(tokens), DIM)
    with torch.no_grad():
        torch.onnx.export(part, (x,), path, input_names=["x"], output_names=["y"], opset_version=18, dynamo=False)


def onnx_int8(source, path, kinds="MatMul,Gemm"):
    """ONNX Runtime's dynamic quantization, a step per channel."""
    from onnxruntime.quantization import QuantType, quantize_dynamic
    from onnxruntime.quantization.shape_inference import quant_pre_process

    big = os.path.getsize(source) < 1 << 20 or len(list(Path(source).parent.glob(Path(source).name + ".*"))) > 0
    ready = path + ".prepared"
    # Without the graph optimiser: it would fuse what quantization wants to see.
    quant_pre_process(source, ready, skip_symbolic_shape=True, skip_optimization=True, save_as_external_data=big)
    quantize_dynamic(
        ready,
        path,
        per_channel=True,
        weight_type=QuantType.QInt8,
        op_types_to_quantize=kinds.split(","),
        use_external_data_format=big,
    )
    for left in Path(path).parent.glob(Path(ready).name + "*"):
        left.unlink()


def openvino_f32(source, path):
    import openvino as ov

    ov.save_model(ov.convert_model(source), path, compress_to_fp16=False)


def openvino_int8(source, path, feeds):
    """NNCF's post-training quantization with calibration inputs (a JSON list of {input: file.npy})."""
    import nncf
    import openvino as ov

    model = ov.Core().read_model(source)
    names = {i.any_name for i in model.inputs}
    samples = [{k: np.load(v) for k, v in feed.items() if k in names} for feed in json.loads(Path(feeds).read_text())]
    quantized = nncf.quantize(
        model,
        nncf.Dataset(samples),
        preset=nncf.QuantizationPreset.MIXED,
        model_type=nncf.ModelType.TRANSFORMER,
        subset_size=len(samples),
        fast_bias_correction=True,
    )
    ov.save_model(quantized, path, compress_to_fp16=False)


if __name__ == "__main__":
    sys.path.insert(0, str(HERE))
    globals()[sys.argv[1]](*sys.argv[2:])
