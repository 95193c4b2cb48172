"""Images of Gaussians that PyTorch can differentiate: the Rust rasterizer through its C interface.

    cargo build --release -p sf-capi        # target/release/libstreetforward.so

`STREETFORWARD_LIBRARY` names another library. The rules of the picture and of its gradients: `docs/rasterizer.md`.
"""

import ctypes
import os
import threading
from ctypes import POINTER, byref, c_char_p, c_double, c_float, c_int, c_int32, c_size_t, c_uint32, c_uint64, c_void_p
from pathlib import Path

import torch
from torch.autograd.function import once_differentiable

ABI_VERSION = 1
# Status of a bug of the library, after which a raster is spent.
INTERNAL = 70


class RasterError(RuntimeError):
    """A call was refused; `status` is the number in `capi/include/streetforward.h`."""

    def __init__(self, status, message):
        super().__init__(f"{message} (status {status})")
        self.status = status


class _Struct(ctypes.Structure):
    """A struct whose first field is its size."""

    def __init__(self, **fields):
        super().__init__(struct_size=ctypes.sizeof(self), **fields)


def _struct(name, *fields):
    return type(name, (_Struct,), {"_fields_": [("struct_size", c_size_t), *fields]})


_GAUSSIANS = ("mean", "scale", "quat", "opacity", "colour")
_IMAGES = ("rgb", "depth", "alpha")

_Gaussians = _struct("_Gaussians", ("count", c_uint64), *((f, c_void_p) for f in _GAUSSIANS))
_View = _struct(
    "_View",
    *((f, c_uint32) for f in ("width", "height")),
    *((f, c_double) for f in ("fx", "fy", "cx", "cy")),
    ("world_to_camera", c_double * 16),
)
_Settings = _struct(
    "_Settings",
    ("antialiased", c_int32),
    *((f, c_float) for f in ("a_max", "eps2d", "near_z")),
    ("background", c_float * 3),
    ("max_entries", c_uint64),
)
_Image = _struct("_Image", ("pixels", c_uint64), *((f, c_void_p) for f in _IMAGES))
_GaussianGradients = _struct("_GaussianGradients", ("count", c_uint64), *((f, c_void_p) for f in (*_GAUSSIANS, "view")))


def _load():
    """The library, its functions declared."""
    target = Path(__file__).parents[2] / "target"
    given = os.environ.get("STREETFORWARD_LIBRARY")
    places = [Path(given)] if given else [target / "release/libstreetforward.so"]
    path = next((p for p in places if p.exists()), None)
    if path is None:
        raise FileNotFoundError(f"{places[0]} does not exist: run `cargo build --release -p sf-capi`")
    library = ctypes.CDLL(str(path))
    library.sf_last_error.argtypes, library.sf_last_error.restype = [c_char_p, c_size_t], c_size_t
    library.sf_abi_version.argtypes, library.sf_abi_version.restype = [], c_uint32
    if library.sf_abi_version() != ABI_VERSION:
        raise ImportError(f"{path} has interface {library.sf_abi_version()}, this file needs {ABI_VERSION}: rebuild it")
    for name, *arguments in (
        ("sf_context_create", c_uint32, POINTER(c_uint64)),
        ("sf_raster_create", c_uint64, POINTER(c_uint64)),
        ("sf_raster_forward", c_uint64, POINTER(_Gaussians), POINTER(_View), POINTER(_Settings), POINTER(_Image)),
        ("sf_raster_backward", c_uint64, POINTER(_Image), POINTER(_GaussianGradients)),
    ):
        function = getattr(library, name)
        function.argtypes, function.restype = arguments, c_int
    return library


class _Rasters:
    """The library with one context, and rasters that are used again: one is taken for every image that may be gone back from."""

    def __init__(self):
        self.library = _load()
        self.process = os.getpid()
        self.lock = threading.Lock()
        self.free = []
        self.context = self.create("sf_context_create", torch.get_num_threads())

    def call(self, name, *arguments):
        status = getattr(self.library, name)(*arguments)
        if status != 0:
            buffer = ctypes.create_string_buffer(512)
            self.library.sf_last_error(buffer, len(buffer))
            raise RasterError(status, buffer.value.decode(errors="replace"))

    def create(self, name, argument):
        handle = c_uint64()
        self.call(name, argument, byref(handle))
        return handle.value

    def take(self):
        with self.lock:
            if self.free:
                return self.free.pop()
        return self.create("sf_raster_create", self.context)


_rasters = None
_rasters_lock = threading.Lock()


def _shared():
    """The process's rasters: threads do not survive a fork."""
    global _rasters
    with _rasters_lock:
        if _rasters is None or _rasters.process != os.getpid():
            _rasters = _Rasters()
        return _rasters


class _Lease:
    """A raster until nobody needs its image any more."""

    def __init__(self):
        self.owner = _shared()
        self.raster = self.owner.take()

    def call(self, name, *arguments):
        try:
            self.owner.call(name, self.raster, *arguments)
        except RasterError as refused:
            if refused.status == INTERNAL:
                del self.raster
            raise

    def __del__(self):
        if hasattr(self, "raster"):
            self.owner.free.append(self.raster)


def _pointer(tensor):
    return None if tensor is None else tensor.data_ptr()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, scales, quats, opacities, colours, view, camera, settings):
        ctx.set_materialize_grads(False)
        (width, height), count = camera["size"], len(means)
        fields = dict(zip(_GAUSSIANS, (means, scales, quats, opacities, colours)))
        fields = {name: value.contiguous() for name, value in fields.items()}
        images = [torch.empty(height, width, 3), torch.empty(height, width), torch.empty(height, width)]
        rows = (c_double * 16)(*view.reshape(16).tolist())
        lease = _Lease()
        lease.call(
            "sf_raster_forward",
            _Gaussians(count=count, **{name: _pointer(value) for name, value in fields.items()}),
            _View(width=width, height=height, world_to_camera=rows, **camera["k"]),
            settings,
            _Image(pixels=width * height, **{name: _pointer(image) for name, image in zip(_IMAGES, images)}),
        )
        # Kept until the graph is gone, so that it can be gone through again.
        ctx.lease = lease if any(ctx.needs_input_grad) else None
        ctx.shapes = [value.shape for value in fields.values()]
        ctx.pixels = width * height
        return tuple(images)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        given = [None if g is None else g.to(torch.float32).contiguous() for g in gradients]
        out = [torch.empty(s) if need else None for s, need in zip(ctx.shapes, ctx.needs_input_grad)]
        view = torch.zeros(4, 4, dtype=torch.float64) if ctx.needs_input_grad[5] else None
        ctx.lease.call(
            "sf_raster_backward",
            _Image(pixels=ctx.pixels, **{name: _pointer(g) for name, g in zip(_IMAGES, given)}),
            _GaussianGradients(
                count=ctx.shapes[0][0],
                view=_pointer(view),
                **{name: _pointer(g) for name, g in zip(_GAUSSIANS, out)},
            ),
        )
        return (*out, view, None, None)


def rasterize(
    means, quats, scales, opacities, colours, view, fx, fy, cx, cy, width, height,
    *, antialiased=False, a_max=0.999, eps2d=0.3, near=0.01, background=(0.0, 0.0, 0.0), max_entries=1 << 26,
):
    """Draws Gaussians: rgb [H, W, 3], depth [H, W] (sum of T alpha z, not divided by alpha) and alpha [H, W], all f32.

    means [N, 3] and view [4, 4] (world to camera, OpenCV axes) in scene units, quats [N, 4] w, x, y, z of any length, scales [N, 3]
    standard deviations, opacities [N] in 0..1, colours [N, 3]; fx, fy, cx, cy in pixels, pixel centres at + 0.5. Tensors on the
    CPU, computed in f32. Gradients reach all six tensors; not the intrinsics. Order, cuts and stops are taken as they are, an alpha at
    `a_max` passes nothing on. The same bits for any number of threads.

    Raises `ValueError` for shapes, `RasterError` for what the library refuses, such as a gradient that is not finite.
    """
    count = len(means)
    tensors = {"means": (means, (count, 3)), "quats": (quats, (count, 4)), "scales": (scales, (count, 3))}
    tensors |= {"opacities": (opacities, (count,)), "colours": (colours, (count, 3)), "view": (view, (4, 4))}
    for name, (tensor, shape) in tensors.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} is {tuple(tensor.shape)}, expected {shape}")
        if tensor.device.type != "cpu":
            raise ValueError(f"{name} is on {tensor.device}: this rasterizer runs on the CPU")
    intrinsics = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    for name, value in intrinsics.items():
        if isinstance(value, torch.Tensor) and value.requires_grad:
            raise ValueError(f"{name} requires a gradient, which intrinsics do not get: detach it")
    settings = _Settings(
        antialiased=bool(antialiased), a_max=a_max, eps2d=eps2d, near_z=near,
        background=(c_float * 3)(*map(float, background)), max_entries=max_entries,
    )
    camera = {"size": (int(width), int(height)), "k": {name: float(value) for name, value in intrinsics.items()}}
    single = (t.to(torch.float32) for t in (means, scales, quats, opacities, colours))
    return _Rasterize.apply(*single, view.to(torch.float64), camera, settings)
