"""The engine of every simulated scene: NVIDIA Warp, on CPU and CUDA."""

from .engine import Engine

ENGINE = Engine("warp", {"mpm": "mpm.solver", "springs": "sheets.springs"}, profiled=True)
