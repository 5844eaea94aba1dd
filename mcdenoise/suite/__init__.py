"""A test suite of rendered frames that no model was trained on: its list of rows, its rendering, and its tables."""
