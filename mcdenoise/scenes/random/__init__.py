"""Parts of random scenes: shapes, materials, furniture, lights, rooms and cameras, in plain Python and numpy."""
