"""Fast forms of ops, each in a file of the name of the op's; imported when one of them is chosen."""
