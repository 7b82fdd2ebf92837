"""Compiles every GPU kernel for CUDA, without a GPU: prints their names, or fails.

The simulator runs kernels as Python; what Numba's CUDA target refuses shows here alone. Run in a
process of its own, by `test_gpu_kernels.py`: it must not be in the simulator.
"""

import types
import warnings
from unittest import mock

from numba import cuda
from numba import types as t

from climatenerf.ops import gpu, gpu_render

F1, F2, F3 = t.float32[::1], t.float32[:, ::1], t.float32[:, :, ::1]
I1, REAL = t.int64[::1], t.float64
NET = t.Tuple((F3, I1, F2, F1, F2, F1))
RAYS, CELLS = t.UniTuple(F2, 2), t.UniTuple(t.Array(t.uint8, 4, "C"), 2)
PAIR = t.UniTuple(REAL, 2)
ARGUMENTS = {
    "_hash_encode": (F2, F3, I1, F2),
    "_hash_encode_backward": (F2, F2, I1, F3),
    "_hash_encode_slopes": (F2, F2, F3, I1, F2),
    "_density_at": (F2, NET, F1),
    "_march": (RAYS, F2, CELLS, PAIR, REAL, NET, F3, I1),
    "_pack": (F3, I1, F2),
    "_grid_positions": (F2, F2, I1, F1, F2),
    "_weights_forward": (F1, I1, F1, F1),
    "_weights_backward": (F1, I1, F1, F1, F1),
    "_accumulate_forward": (F1, F2, I1, F2),
    "_accumulate_backward": (F1, F2, I1, F2, F1, F2),
    "_distortion_forward": (F1, F1, F1, I1, F1),
    "_distortion_backward": (F1, F1, F1, I1, F1, F1),
    "_merge_order": (F1, I1, F1, I1, I1, I1),
    "_adam": (F1, F1, F1, F1, t.UniTuple(t.float32, 6)),
    "_composite": (RAYS, F2, CELLS, PAIR, PAIR, NET, NET, F2, F2),
}


def main() -> None:
    warnings.simplefilter("ignore")
    kernels = {
        name: each
        for module in (gpu, gpu_render)
        for name, each in vars(module).items()
        if hasattr(each, "targetoptions") and not each.targetoptions.get("device")
    }
    card = types.SimpleNamespace(compute_capability=(8, 0))
    with mock.patch("numba.cuda.dispatcher.get_current_device", return_value=card):
        for name, kernel in kernels.items():
            text, _ = cuda.compile_ptx(kernel.py_func, ARGUMENTS[name], cc=(8, 0))
            assert ".entry" in text
            print(name)


if __name__ == "__main__":
    main()
