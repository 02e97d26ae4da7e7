"""Compiles Pallas kernels to machine code of CPUs and NVIDIA GPUs; knows nothing of hands."""
