"""StreetForward in PyTorch: the readable model that the Rust engine is checked against."""

from .config import preset, with_linear_heads
from .model import StreetForward

__all__ = ["StreetForward", "preset", "with_linear_heads"]
