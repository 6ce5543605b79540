"""Averages the weights of two exported models: SHARE of SECOND and the rest of FIRST.

    python configs/bundled/average.py FIRST.safetensors SECOND.safetensors SHARE OUT.safetensors

The header (statistics, configuration, layout) is that of SECOND. Needs numpy and safetensors.
"""

import sys

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file


def read(path):
    """Tensors as float32, and the header."""
    with safe_open(path, framework="np") as file:
        return {name: file.get_tensor(name).astype(np.float32) for name in file.keys()}, file.metadata()


first, second, share, out = sys.argv[1:]
(before, _), (after, header) = read(first), read(second)
share = np.float32(share)
save_file({name: share * after[name] + (1 - share) * before[name] for name in after}, out, header)
