"""Fused steps: runs of ops, and of torch's, that a method needs in one pass over the image.

Each is a function with a contract and a reference implementation that says what it computes, and chooses its fast
backend itself, as the public ops do. They are private because their contracts are those of the methods that call them.
"""
