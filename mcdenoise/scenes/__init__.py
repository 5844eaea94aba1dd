"""Scenes to render: demonstration scenes, random scenes, and rendering of any Mitsuba 3 scene."""
