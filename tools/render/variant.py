"""Mitsuba with its just-in-time compiler. Import it from here, so that its variant is set."""

import os
from glob import glob

if newest := sorted(glob("/usr/lib/*/libLLVM.so.[0-9]*"), key=lambda path: float(path.rpartition(".so.")[2])):
    # Dr.Jit takes any version, but LLVM 15 cannot compile these kernels for AVX-512.
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", newest[-1])

import mitsuba as mi  # noqa: E402

mi.set_variant("llvm_ad_rgb")
mi.set_log_level(mi.LogLevel.Error)
__all__ = ["mi"]
