"""The proof, outside the shop window: cases and equations of every op, gradient checks, stability, and the overview."""
