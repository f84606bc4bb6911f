"""numba kernels of the operators, CPU float32: each is held to its definition in `torchbokeh.ops`."""
