"""Forms of ops for NVIDIA GPUs, in Triton, each in a file of the name of its op's; imported when one is chosen."""
