"""Forms of ops for the CPU, compiled by numba, each in a file of the name of its op's; imported when one is chosen."""
