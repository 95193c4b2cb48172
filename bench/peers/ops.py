"""Single operations in other runtimes, built in place: int8 products, a 3x3 convolution, attention over frames in sight."""

import numpy as np


def build(spec, torch_setup, openvino_model, onnxruntime_model):
    make = globals()[f"{spec['op']}_{spec['runtime']}"]
    return make(spec, {"torch": torch_setup, "openvino": openvino_model, "onnxruntime": onnxruntime_model})


def random_f32(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def random_s8(seed, *shape):
    return np.random.default_rng(seed).integers(-127, 128, shape, dtype=np.int8)


# --- products: m k n ---


def gemm_pytorch(spec, setup):
    """s8 times s8 to i32: no bias, no scales."""
    torch = setup["torch"](spec)
    m, k, n = spec["sizes"]
    a, b = torch.from_numpy(random_s8(1, m, k)), torch.from_numpy(random_s8(2, n, k)).t()
    return lambda: {"y": torch._int_mm(a, b)}


def linear_pytorch(spec, setup):
    """f32 to f32 with weights quantized beforehand and activations while it runs."""
    torch = setup["torch"](spec)
    from torch.ao.quantization import quantize_dynamic

    torch.backends.quantized.engine = spec["engine"]
    m, k, n = spec["sizes"]
    layer = quantize_dynamic(torch.nn.Sequential(torch.nn.Linear(k, n)), {torch.nn.Linear}, dtype=torch.qint8)
    x = torch.from_numpy(random_f32(1, m, k))
    return lambda: {"y": layer(x)}


def onnx_graph(nodes, constants, x, y):
    from onnx import TensorProto, helper, numpy_helper

    kinds = {np.float32: TensorProto.FLOAT, np.int8: TensorProto.INT8, np.uint8: TensorProto.UINT8, np.int32: TensorProto.INT32}
    info = lambda name, value, kind: helper.make_tensor_value_info(name, kinds[kind], value)
    graph = helper.make_graph(
        nodes,
        "op",
        [info("x", x.shape, x.dtype.type)],
        [info("y", y[0], y[1])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    return model.SerializeToString()


def gemm_onnxruntime(spec, setup):
    """MatMulInteger, u8 times s8 to i32."""
    from onnx import helper

    m, k, n = spec["sizes"]
    x = np.random.default_rng(1).integers(0, 256, (m, k), dtype=np.uint8)
    constants = {"w": random_s8(2, k, n), "xz": np.array(128, np.uint8), "wz": np.array(0, np.int8)}
    node = helper.make_node("MatMulInteger", ["x", "w", "xz", "wz"], ["y"])
    graph = onnx_graph([node], constants, x, ((m, n), np.int32))
    return setup["onnxruntime"](spec | {"model": graph}, {"x": x})


def linear_onnxruntime(spec, setup):
    """DynamicQuantizeLinear, MatMulInteger, scale and bias: what its dynamic quantization makes of a linear layer."""
    from onnx import helper

    m, k, n = spec["sizes"]
    x = random_f32(1, m, k)
    constants = {
        "w": random_s8(2, k, n),
        "wz": np.zeros(n, np.int8),
        "ws": np.full(n, 0.001, np.float32),
        "b": random_f32(3, n),
    }
    nodes = [
        helper.make_node("DynamicQuantizeLinear", ["x"], ["q", "s", "z"]),
        helper.make_node("MatMulInteger", ["q", "w", "z", "wz"], ["i"]),
        helper.make_node("Cast", ["i"], ["f"], to=1),
        helper.make_node("Mul", ["s", "ws"], ["ss"]),
        helper.make_node("Mul", ["f", "ss"], ["g"]),
        helper.make_node("Add", ["g", "b"], ["y"]),
    ]
    return setup["onnxruntime"](spec | {"model": onnx_graph(nodes, constants, x, ((m, n), np.float32))}, {"x": x})


def fake_quantized(ops, value, low, high, levels):
    limits = [ops.constant(np.asarray(v, np.float32)) for v in (low, high, low, high)]
    return ops.fake_quantize(value, *limits, levels)


def linear_openvino(spec, setup):
    """f32 to f32 around an int8 product with a static activation scale."""
    import openvino as ov
    from openvino import opset13 as ops

    m, k, n = spec["sizes"]
    x = random_f32(1, m, k)
    parameter = ops.parameter([m, k], np.float32, name="x")
    weights = random_f32(2, n, k)
    reach = np.abs(weights).max(axis=1, keepdims=True)
    # Named limits keep the signed range of 255 levels.
    product = ops.matmul(
        fake_quantized(ops, parameter, -4.0, 4.0 * 127 / 128, 256),
        fake_quantized(ops, ops.constant(weights), -reach, reach, 255),
        False,
        True,
    )
    y = ops.add(product, ops.constant(random_f32(3, 1, n)))
    return setup["openvino"](spec | {"built": ov.Model([y], [parameter], "linear")}, {"x": x})


# --- 3x3 convolution with ReLU: h w c n ---


def conv_pytorch(spec, setup):
    """u8 map in and out (quantized beforehand), s8 weights."""
    torch = setup["torch"](spec)
    from torch.ao.nn.intrinsic.quantized import ConvReLU2d

    torch.backends.quantized.engine = spec["engine"]
    h, w, c, n = spec["sizes"]
    layer = ConvReLU2d(c, n, 3, padding=1)
    weight = torch.quantize_per_channel(
        torch.from_numpy(random_f32(2, n, c, 3, 3)), torch.full((n,), 0.03), torch.zeros(n, dtype=torch.long), 0, torch.qint8
    )
    layer.set_weight_bias(weight, torch.from_numpy(random_f32(3, n)))
    layer.scale, layer.zero_point = 1.0, 0
    x = torch.from_numpy(random_f32(1, 1, c, h, w)).contiguous(memory_format=torch.channels_last)
    x = torch.quantize_per_tensor(x, 0.03, 128, torch.quint8)
    return lambda: {"y": layer(x)}


def conv_onnxruntime(spec, setup):
    """f32 in and out around QLinearConv."""
    from onnx import helper

    h, w, c, n = spec["sizes"]
    x = random_f32(1, 1, c, h, w)
    constants = {
        "s": np.array(0.03, np.float32),
        "z": np.array(128, np.uint8),
        "w": random_s8(2, n, c, 3, 3),
        "ws": np.full(n, 0.001, np.float32),
        "wz": np.zeros(n, np.int8),
        "ys": np.array(0.05, np.float32),
        "yz": np.array(0, np.uint8),
        "b": np.zeros(n, np.int32),
    }
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"]),
        helper.make_node(
            "QLinearConv", ["q", "s", "z", "w", "ws", "wz", "ys", "yz", "b"], ["r"], kernel_shape=[3, 3], pads=[1, 1, 1, 1]
        ),
        helper.make_node("DequantizeLinear", ["r", "ys", "yz"], ["y"]),
    ]
    return setup["onnxruntime"](spec | {"model": onnx_graph(nodes, constants, x, ((1, n, h, w), np.float32))}, {"x": x})


def conv_openvino(spec, setup):
    """f32 in and out around an int8 convolution with static scales."""
    import openvino as ov
    from openvino import opset13 as ops

    h, w, c, n = spec["sizes"]
    x = random_f32(1, 1, c, h, w)
    parameter = ops.parameter([1, c, h, w], np.float32, name="x")
    weights = random_f32(2, n, c, 3, 3)
    reach = np.abs(weights).max(axis=(1, 2, 3), keepdims=True)
    y = ops.convolution(
        fake_quantized(ops, parameter, -4.0, 4.0 * 127 / 128, 256),
        fake_quantized(ops, ops.constant(weights), -reach, reach, 255),
        [1, 1],
        [1, 1],
        [1, 1],
        [1, 1],
    )
    y = ops.relu(ops.add(y, ops.constant(random_f32(3, 1, n, 1, 1))))
    return setup["openvino"](spec | {"built": ov.Model([y], [parameter], "conv")}, {"x": x})


# --- attention: frames tokens heads d lo hi ---


def heads_of(spec):
    frames, tokens, heads, d, lo, hi = spec["sizes"]
    return [random_f32(seed, frames, heads, tokens, d) for seed in (1, 2, 3)], (frames, lo, hi)


def attention_pytorch(spec, setup):
    """Scaled dot product attention on slices of the frames in sight, f32."""
    torch = setup["torch"](spec)
    import parts  # noqa: F401  puts the training code on the path
    from streetforward.graph import attend, sight

    (q, k, v), reach = heads_of(spec)
    q, k, v = (torch.from_numpy(t) for t in (q, k, v))
    groups = sight(*reach)
    return lambda: {"y": attend(q, k, v, groups)}


def attention_dense_pytorch(spec, setup):
    """The same with a mask over all tokens."""
    torch = setup["torch"](spec)
    import parts  # noqa: F401
    from streetforward.causal import frame_mask

    (q, k, v), (frames, lo, hi) = heads_of(spec)
    q, k, v = (torch.from_numpy(t).transpose(0, 1).flatten(1, 2)[None].contiguous() for t in (q, k, v))
    tokens = spec["sizes"][1]
    mask = frame_mask(frames, lo, hi).repeat_interleave(tokens, 0).repeat_interleave(tokens, 1)
    attention = torch.nn.functional.scaled_dot_product_attention
    return lambda: {"y": attention(q, k, v, attn_mask=mask)}


def attention_openvino(spec, setup):
    """Its fused attention on the same slices, f32."""
    import openvino as ov
    import parts  # noqa: F401
    from openvino import opset13 as ops
    from streetforward.graph import sight

    (q, k, v), reach = heads_of(spec)
    inputs = [ops.parameter(t.shape, np.float32, name=name) for name, t in zip("qkv", (q, k, v))]

    def frames(node, first, end):
        index = lambda n: ops.constant(np.array([n], np.int64))
        return ops.slice(node, index(first), index(end), index(1), index(0))

    results = []
    for first, end, offsets in sight(*reach):
        keys, values = (
            ops.concat([frames(node, first + o, end + o) for o in offsets], 2) for node in inputs[1:]
        )
        results.append(ops.scaled_dot_product_attention(frames(inputs[0], first, end), keys, values))
    model = ov.Model([ops.concat(results, 0)], inputs, "attention")
    return setup["openvino"](spec | {"built": model}, dict(zip("qkv", (q, k, v))))
