"""What can be rendered: the scene of the demonstration, random ones, and any of Mitsuba 3."""
